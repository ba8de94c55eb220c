"""One style for every report: a self-contained page that reads in light and in dark, on a desk, on a tablet and on paper."""

from importlib.resources import files
from typing import Any

import jinja2
from markupsafe import Markup

STYLE, MACROS = "page.css", "page.html.j2"
"""The style sheet and the macros of all templates, beside this file. A template adds only what no other page has."""


def rendered_page(room: str, template: str, **content: Any) -> str:
    """Fill a template with content; every text is escaped.

    Args:
        room: Package that the template stands in.
        template: Name of its file; it puts `style` between its style tags.
    """
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined)
    shared = files("palpd.analysis")
    source = shared.joinpath(MACROS).read_text(encoding="utf-8") + files(room).joinpath(template).read_text(encoding="utf-8")
    style = shared.joinpath(STYLE).read_text(encoding="utf-8")
    return environment.from_string(source).render(style=Markup(style.strip()), **content)
