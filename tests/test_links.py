"""Where documents, code and the Makefile point: links, anchors, sections of the contract, files of ARCHITECTURE.md, tests left out."""

import ast
import re
import subprocess
from pathlib import Path

import pytest

from tests.pages import FENCE
from tests.paths import ROOT

PAGES = sorted(
    path for folder in ("", "docs", "models", "palpd", "systemd", "tests") for path in (ROOT / folder).glob("**/*.md" if folder else "*.md")
)
MODULES = sorted(path for folder in ("palpd", "hw", "tests", "benchmarks") for path in (ROOT / folder).rglob("*.py"))
CONTRACT, GLOSSARY = "docs/reference/contract.md", "docs/reference/glossary.md"
LINK = re.compile(r"\]\(([^)\s]+)\)")
SECTION = re.compile(r"§\s?(\d+)")
NAMED = {CONTRACT: re.compile(r"\bthe\s+contract\b|§", re.IGNORECASE), GLOSSARY: re.compile(r"\bthe\s+glossary\b", re.IGNORECASE)}


def anchors_of(page: Path) -> set[str]:
    """The anchors of the headings of a page, as GitHub and MkDocs name them."""
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    headings = re.findall(r"^#+ (.+)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", LINK.sub("]", heading)).strip().lower().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_relative_link_of_a_page_has_its_target(page: Path) -> None:
    text = re.sub(r"`[^`\n]*`", "", FENCE.sub("", page.read_text(encoding="utf-8")))
    for link in LINK.findall(text):
        if re.match(r"[a-z]+:", link):
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), link
        assert not anchor or anchor in anchors_of(target), link


def test_code_that_refers_to_the_contract_or_the_glossary_names_the_page_and_a_section_that_is_there() -> None:
    sections = set(re.findall(r"^## (\d+)\. ", (ROOT / CONTRACT).read_text(encoding="utf-8"), flags=re.MULTILINE))
    for module in MODULES:
        text = module.read_text(encoding="utf-8")
        assert set(SECTION.findall(text)) <= sections, module
        for page, named in NAMED.items():
            assert page.removeprefix("docs/") in text or not named.search(text), f"{module} does not say that it means {page}"


def test_every_definition_that_architecture_names_stands_in_its_file() -> None:
    rows = re.findall(
        r"^\| [^|]* \| `(\S+\.py)` \| `(\w+)` \| [^|]* \|$", (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8"), flags=re.MULTILINE
    )
    assert len(rows) > 30
    for name, definition in rows:
        defined = re.compile(rf"^(?:(?:def|class) {definition}\b|{definition}\b[^=\n]*= )", flags=re.MULTILINE)
        assert defined.search((ROOT / name).read_text(encoding="utf-8")), f"{definition} does not stand in {name}"


def test_the_way_of_a_recording_through_the_diagnosis_is_that_of_the_code() -> None:
    """Each function stands in its file, and its annotations hold the types that the table names."""
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| [\w, ]+ \| `(\w+)` \| ([^|]+) \| ([^|]+) \| `(\S+\.py)` \|$", text, flags=re.MULTILINE)
    assert len(rows) > 20
    for function, takes, gives, name in rows:
        module = ast.parse((ROOT / "palpd" / "gap" / name).read_text(encoding="utf-8"))
        (definition,) = (node for node in module.body if isinstance(node, ast.FunctionDef) and node.name == function)
        for types, annotated in ((takes, ast.unparse(definition.args)), (gives, ast.unparse(definition.returns or ast.Constant(None)))):
            missing = set(re.findall(r"`([A-Z]\w+)`", types.partition(":")[0])) - set(re.findall(r"\w+", annotated))
            assert not missing, f"{function} in {name}: {missing}"


def test_what_make_quick_leaves_out_is_there() -> None:
    printed = subprocess.run(["make", "--dry-run", "quick"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    left_out = re.findall(r"--ignore=(\S+)", printed)
    assert left_out
    assert [path for path in left_out if not (ROOT / path).exists()] == []
