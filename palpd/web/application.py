"""The application: what it is made of, and where a further page or stream is added.

To add something:

- a module with `routes(page: Page) -> list[BaseRoute]`, named in `build`;
- what runs beside the requests, as an async context manager, entered in `lifespan`;
- a page: `pages/NAME.html` and, as an ES module, `static/NAME.js`, shown with `shell.page(...)`; a further tab is a line of `shell.TABS`.

Every route stands behind `access.Access`: it needs an open session, and POST requests need the mark of the page (`ask` of
`static/requests.js` sends it). A route that imports something heavy (scipy, matplotlib, `palpd.history.catalogue`) does so in the process
of `aside.Aside`, never here: the server stays below 60 MB.
"""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from urllib.parse import urlsplit

from starlette.applications import Starlette
from starlette.routing import BaseRoute, Mount
from starlette.staticfiles import StaticFiles

from palpd.web import calculations, commission_pages, controls, history_pages, live, plan_pages, resolve_pages, shell
from palpd.web.access import Access
from palpd.web.page import Page, PageSettings
from palpd.web.sessions import Sessions


def build(settings: PageSettings, sessions: Sessions) -> Starlette:
    """Make the application.

    Args:
        settings: Addresses and folders.
        sessions: Who may use it.

    Returns:
        The ASGI application.
    """
    page = Page(settings)

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        async with live.background(page.live):
            yield
        await page.talk.interrupt()
        page.aside.close()
        await page.children.close()

    routes: list[BaseRoute] = [*shell.routes(settings.camera_url), *live.routes(page.live)]
    for part in (controls, calculations, history_pages, plan_pages, resolve_pages, commission_pages):
        routes += part.routes(page)
    application = Starlette(routes=[*routes, Mount("/static", StaticFiles(directory=shell.STATIC))], lifespan=lifespan)
    camera = urlsplit(settings.camera_url or "")
    application.add_middleware(
        Access,
        sessions=sessions,
        hosts=settings.hosts,
        cookie=f"palpd_{settings.port}",
        entrance=shell.entrance,
        first="/setup" if settings.setup else "/",
        pictures_from=f"{camera.scheme}://{camera.netloc}" if camera.netloc else None,
    )
    application.state.page = page
    return application
