"""One file of a module and of what it uses of palpd, so that an export runs where palpd is not installed.

The definitions are copied word by word, so the export computes with the same physics and cannot drift from it. What only annotations
name is left out where it is a class: annotations are not evaluated in the copy.
"""

import ast
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

from palpd.errors import BadInput

Definition = tuple[Path, str]
"""A file and a name that it defines at its top level."""


@dataclass(frozen=True)
class _Source:
    """A file: its statements by the names that they define, and what it imports under which name."""

    path: Path
    lines: list[str]
    body: list[ast.stmt]
    defines: dict[str, int]
    imports: dict[str, tuple[str | None, str]]

    @staticmethod
    def of(path: Path) -> "_Source":
        text = path.read_text(encoding="utf-8")
        body = ast.parse(text).body
        defines: dict[str, int] = {}
        imports: dict[str, tuple[str | None, str]] = {}
        for number, node in enumerate(body):
            if isinstance(node, ast.ImportFrom):
                imports |= {alias.asname or alias.name: (node.module, alias.name) for alias in node.names}
            elif isinstance(node, ast.Import):
                imports |= {alias.asname or alias.name: (None, alias.name) for alias in node.names}
            else:
                defines |= dict.fromkeys(_defined_by(node), number)
        return _Source(path, text.splitlines(), body, defines, imports)

    def text(self, number: int) -> str:
        """A statement, with the note that stands below a constant."""
        node = self.body[number]
        decorators = getattr(node, "decorator_list", [])
        first = min([node.lineno, *(decorator.lineno for decorator in decorators)])
        last = node.end_lineno or node.lineno
        following = self.body[number + 1] if number + 1 < len(self.body) else None
        if isinstance(node, ast.Assign | ast.AnnAssign) and _is_text(following) and following is not None:
            last = following.end_lineno or last
        return "\n".join(self.lines[first - 1 : last])


def _is_text(node: ast.stmt | None) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _defined_by(node: ast.stmt) -> list[str]:
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return [node.name]
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    return [name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)]


class _Uses(ast.NodeVisitor):
    """The names that a statement needs to run, and those that its annotations name."""

    def __init__(self) -> None:
        self.needed: set[str] = set()
        self.named: set[str] = set()
        self._evaluates = False

    def visit_Name(self, node: ast.Name) -> None:
        self.needed.add(node.id)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        # A pydantic model evaluates the annotations of its fields; a dataclass and a named tuple do not.
        before, self._evaluates = self._evaluates, any(getattr(base, "id", "") not in ("NamedTuple", "Effect") for base in node.bases)
        self.generic_visit(node)
        self._evaluates = before

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        before, self._evaluates = self._evaluates, False
        self.generic_visit(node)
        self._evaluates = before

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        self._annotation(node.annotation)
        self.visit(node.target)
        if node.value is not None:
            self.visit(node.value)

    def visit_arg(self, node: ast.arg) -> None:
        self._annotation(node.annotation)

    def generic_visit(self, node: ast.AST) -> None:
        for name, value in ast.iter_fields(node):
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    if name == "returns":
                        self._annotation(child)
                    else:
                        self.visit(child)

    def _annotation(self, node: ast.AST | None) -> None:
        if node is not None:
            names = {name.id for name in ast.walk(node) if isinstance(name, ast.Name)}
            (self.needed if self._evaluates else self.named).update(names)


@dataclass
class _Bundle:
    """What is copied so far: statements by file, in the order in which they can run, and imports of other packages."""

    sources: dict[Path, _Source] = field(default_factory=dict)
    statements: dict[Path, set[int]] = field(default_factory=dict)
    imports: set[tuple[str | None, str, str]] = field(default_factory=set)
    owners: dict[str, Definition] = field(default_factory=dict)
    order: list[Path] = field(default_factory=list)

    def source(self, path: Path) -> _Source:
        if path not in self.sources:
            self.sources[path] = _Source.of(path)
        return self.sources[path]

    def add(self, path: Path, name: str, *, as_annotation: bool = False) -> None:
        """Copy what defines a name that a file uses, and what that needs."""
        source = self.source(path)
        if name in source.imports:
            module, original = source.imports[name]
            if module is None or not module.startswith("palpd"):
                self.imports.add((module, original, name))
            else:
                self.add(_file_of(module), original, as_annotation=as_annotation)
        elif name in source.defines:
            number = source.defines[name]
            if not (as_annotation and isinstance(source.body[number], ast.ClassDef | ast.FunctionDef)):
                self.add_statement(path, number)

    def add_statement(self, path: Path, number: int) -> None:
        source = self.source(path)
        if number in self.statements.setdefault(path, set()):
            return
        self.statements[path].add(number)
        for name in _defined_by(source.body[number]):
            if self.owners.setdefault(name, (path, name)) != (path, name):
                raise BadInput(
                    f"{path.name} and {self.owners[name][0].name} both define {name}, and an export puts both into one file; rename one"
                )
        uses = _Uses()
        uses.visit(source.body[number])
        for name in sorted(uses.needed):
            self.add(path, name)
        for name in sorted(uses.named - uses.needed):
            self.add(path, name, as_annotation=True)
        if path not in self.order:
            self.order.append(path)


def _file_of(module: str) -> Path:
    spec = find_spec(module)
    assert spec is not None
    assert spec.origin is not None
    return Path(spec.origin)


def bundled(entry: Path, definitions: Sequence[Definition], tail: str, written_by: str) -> str:
    """The text of one file that holds a module and what it needs of palpd.

    Args:
        entry: File of the module; all of it is copied.
        definitions: What the export needs besides.
        tail: Lines that stand after all definitions.
        written_by: Sentence that says where the file comes from.

    Raises:
        BadInput: Two files define the same name.
    """
    out = _Bundle()
    source = out.source(entry)
    for path, name in definitions:
        out.add(path, name)
    for number, node in enumerate(source.body):
        if not isinstance(node, ast.Import | ast.ImportFrom) and not _is_text(node):
            out.add_statement(entry, number)
    out.order.remove(entry)
    parts = [f'"""{ast.get_docstring(ast.parse(entry.read_text(encoding="utf-8")))}\n\n{written_by}\n"""']
    parts += ["from __future__ import annotations", "\n".join(_import_lines(out.imports))]
    for path in (*_by_need(out), entry):
        chosen = out.sources[path]
        parts.append(f"\n# --- {_shown(path)} " + "-" * max(100 - len(_shown(path)), 3))
        numbers = [number for number in sorted(out.statements[path]) if not _runs_as_program(chosen.body[number])]
        parts += [_spaced(chosen.text(number), chosen.body[number]) for number in numbers]
    parts.append(tail)
    parts += [source.text(number) for number, node in enumerate(source.body) if _runs_as_program(node)]
    return "\n\n".join(parts) + "\n"


def _spaced(text: str, node: ast.stmt) -> str:
    return "\n" + text if isinstance(node, ast.ClassDef | ast.FunctionDef) else text


def _shown(path: Path) -> str:
    parts = path.parts
    return "/".join(parts[len(parts) - 1 - parts[::-1].index("palpd") :]) if "palpd" in parts else path.name


def _runs_as_program(node: ast.stmt) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test) == "__name__ == '__main__'"


def _by_need(out: _Bundle) -> list[Path]:
    """The files, each after those that it imports from."""
    done: list[Path] = []

    def place(path: Path) -> None:
        for module, _ in out.sources[path].imports.values():
            if module is not None and module.startswith("palpd"):
                needed = _file_of(module)
                if needed in out.order and needed not in done and needed != path:
                    place(needed)
        if path not in done:
            done.append(path)

    for path in out.order:
        place(path)
    return done


def _import_lines(imports: Iterable[tuple[str | None, str, str]]) -> list[str]:
    lines = []
    for module, original, name in sorted(imports, key=lambda one: (one[0] or one[1], one[1])):
        called = original if original == name else f"{original} as {name}"
        lines.append(f"import {called}" if module is None else f"from {module} import {called}")
    return lines
