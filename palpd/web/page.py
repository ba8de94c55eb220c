"""What all routes of the page share, and what `palpd web` passes on."""

from dataclasses import dataclass, field
from pathlib import Path

from palpd.web.aside import Aside
from palpd.web.children import Children
from palpd.web.live import Live
from palpd.web.service_link import ServiceLink
from palpd.web.setup_talk import SetupTalk


@dataclass(frozen=True, slots=True)
class PageSettings:
    """What `palpd web` passes on: plain values, so that the server need not import the configuration."""

    socket: Path
    """Control socket of the service."""
    runs: Path
    """Folder of the recordings, for reading."""
    listen: str = "127.0.0.1"
    """Address to listen at."""
    port: int = 8700
    names: tuple[str, ...] = ()
    """Further host names under which browsers may open the page."""
    plan: Path | None = None
    """Plan that the page offers first."""
    config: Path | None = None
    """config.yaml of the cell, for the commands that judge and rehearse a plan."""
    setup: Path | None = None
    """Folder of the cell that the page leads a set-up of; None: it only shows what was set up."""
    camera_url: str | None = None
    """Address of a camera's picture, as the configuration allows it: no password, no blank, no quote."""

    @property
    def hosts(self) -> frozenset[str]:
        """All hosts, with port, under which the page is served."""
        listened = () if self.listen in ("0.0.0.0", "::") else (self.listen,)
        names = ("127.0.0.1", "localhost", "[::1]", *(f"[{name}]" if ":" in name else name for name in (*listened, *self.names)))
        return frozenset(f"{name}:{self.port}" for name in names)


@dataclass(slots=True)
class Page:
    """What all routes share."""

    settings: PageSettings
    aside: Aside = field(default_factory=Aside)
    children: Children = field(default_factory=Children)
    link: ServiceLink = field(init=False)
    live: Live = field(init=False)
    talk: SetupTalk = field(init=False)

    def __post_init__(self) -> None:
        self.link = ServiceLink(self.settings.socket)
        self.live = Live(self.link, self.aside)
        self.talk = SetupTalk(self.settings.setup, self.live.publish)
        self.live.greetings.append(lambda: self.talk.event)
