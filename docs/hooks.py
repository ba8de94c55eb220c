"""What the build of the site needs besides docs/mkdocs.yml."""

from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.pages import Page


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Take this folder for the pages; MkDocs refuses it as `docs_dir`, since its own configuration stands in it."""
    config.docs_dir = str(Path(__file__).parent)
    return config


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Let a search find pages that say how before pages of results."""
    if page.file.src_uri.partition("/")[0] in (
        "reference",
        "how-to",
        "tutorials",
        "explanation",
        "start.md",
        "import.md",
        "cell.md",
        "api.md",
    ):
        page.meta["search"] = {"boost": 3}
    return markdown
