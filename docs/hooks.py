"""What the build of the site needs besides docs/mkdocs.yml: the folder, the weights of the search, and the notebooks as pages."""

import base64
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nbformat
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from nbclient import NotebookClient

HERE = Path(__file__).parent
PRACTICAL = ("reference", "how-to", "tutorials", "explanation", "notebooks", "start.md", "import.md", "cell.md", "api.md", "what-works.md")
"""Folders and pages that say how; a search shows them before pages of results."""
CELL_TIMEOUT_S = 600
"""Longest time of a cell of a notebook: a diagnosis takes 10 s, and the machine may be busy."""


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Take this folder for the pages; MkDocs refuses it as `docs_dir`, since its own configuration stands in it."""
    config.docs_dir = str(HERE)
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page for each notebook, with the outputs of its cells, which run now; the notebook itself can be downloaded."""
    for notebook in [file for file in files if file.src_uri.endswith(".ipynb")]:
        text, pictures = rendered(HERE / notebook.src_uri)
        files.append(File.generated(config, notebook.src_uri.replace(".ipynb", ".md"), content=text))
        for name, content in pictures.items():
            files.append(File.generated(config, f"{Path(notebook.src_uri).parent.as_posix()}/{name}", content=content))
    return files


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Let a search find pages that say how before pages of results; on the site a link to a notebook leads to its page."""
    if page.file.src_uri.partition("/")[0] in PRACTICAL:
        page.meta["search"] = {"boost": 3}
    return markdown if page.file.generated_by else markdown.replace(".ipynb)", ".md)")


def rendered(path: Path) -> tuple[str, dict[str, bytes]]:
    """A notebook as Markdown, with the pictures that it shows by their names."""
    notebook = nbformat.read(path, as_version=4)
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (str(HERE.parent), os.environ.get("PYTHONPATH"))))
    quiet = ["--IPKernelApp.log_level=40"]  # a kernel on this computer warns that its connection is not encrypted
    with tempfile.TemporaryDirectory() as folder:
        where = {"metadata": {"path": folder}}
        NotebookClient(notebook, timeout=CELL_TIMEOUT_S, kernel_name="python3", resources=where, extra_arguments=quiet).execute()
    parts, pictures = [], dict[str, bytes]()
    for cell in notebook.cells:
        parts.append(cell.source if cell.cell_type == "markdown" else f"```python\n{cell.source}\n```")
        for output in cell.get("outputs", ()):
            parts += shown(output, f"{path.stem}-{len(pictures) + 1}.png", pictures)
    title, *rest = parts
    note = f"*This page is a notebook with its outputs: [{path.name}]({path.name}) to download.*"
    return "\n\n".join([title, note, *rest]) + "\n", pictures


def shown(output: Any, name: str, pictures: dict[str, bytes]) -> Iterator[str]:
    """An output of a cell as Markdown; a picture is kept under that name."""
    data = output.get("data", {"text/plain": output.get("text", "")})
    if "image/png" in data:
        pictures[name] = base64.b64decode(data["image/png"])
        yield f"![Figure of the cell above]({name})"
    elif "text/html" in data:
        yield f'<div markdown="0">\n{data["text/html"]}\n</div>'
    else:
        yield f"```\n{data['text/plain'].rstrip()}\n```"
