"""The addresses of alarms: read from a file that is secret as a whole, and sent to by apprise.

No sentence here holds a part of an address.
"""

import logging
import os
import re
import stat
from pathlib import Path
from urllib.parse import unquote

from palpd.config import AlarmsConfig
from palpd.documents import parse_yaml
from palpd.errors import BadInput, ConfigError, PalpdError, Refused
from palpd.files import read_text

CREDENTIAL = "palpd-alarms"
"""Name of the credential in the unit: `LoadCredential=palpd-alarms:/etc/palpd/alarms.yaml`."""
INSTALLED = Path("/etc/palpd/alarms.yaml")
"""Where the unit has it from."""
SEND_S = 30.0
"""Longest wait for an address; one that is slow is tried again later."""
SHORTEST_SECRET = 3
"""Letters of a part of an address from which on it is taken out of what is printed."""
PAGE = "see docs/how-to/alarms.md"


class Address:
    """One address under its name. Raises BadInput without the library apprise, ConfigError for an address that it does not know."""

    def __init__(self, name: str, url: str) -> None:
        try:
            from apprise import Apprise, LogCapture
        except ImportError:
            raise BadInput("alarms need apprise, which is not installed; install palpd[alarms]") from None
        self.name = name
        self._secrets, self._apprise = _parts_of(url), Apprise()
        logging.getLogger("apprise").propagate = False  # its warnings hold addresses
        with LogCapture(level=logging.WARNING, fmt="%(message)s") as log:  # type: ignore[no-untyped-call]
            service = Apprise.instantiate(url)
            reason = self._without_secrets("; ".join(log.getvalue().split("\n")[:-1]))
        if service is None:
            raise ConfigError(f"the address of alarms {name!r} cannot be used ({reason}), expected such as ntfys://ntfy.sh/topic; {PAGE}")
        self._apprise.add(service)

    def send(self, title: str, body: str) -> str:
        """Send a message, which may take seconds. Returns why it was not taken, without a part of the address; empty where it was."""
        try:
            result = self._apprise.notify(title=title, body=body, timeout=SEND_S)
        except Exception as error:  # a foreign plug-in may raise anything, and its text may hold the address
            return type(error).__name__
        if result:
            return ""
        reasons = [entry.message.strip().rstrip(".") for entry in result.logs() if entry.level in ("WARNING", "ERROR")]
        return self._without_secrets("; ".join(reasons)) or f"no answer within {SEND_S:g} s"

    def _without_secrets(self, words: str) -> str:
        """Take addresses out of apprise's words, also those that it shortens to `p...1`, and then every part of this one."""
        return re.sub("|".join([r"\S*://\S*", *map(re.escape, self._secrets)]), "…", words, flags=re.IGNORECASE)


def read_addresses(alarms: AlarmsConfig) -> list[Address]:
    """Read the addresses that the configuration names.

    Raises:
        BadInput: None is named, or apprise is not installed.
        Refused: The file cannot be read, or everybody may read it.
        ConfigError: It does not have an address, or a wrong one.
    """
    if not alarms.addresses:
        raise BadInput(f"alarms.addresses of config.yaml is empty, expected names such as [phone, mail]; {PAGE}")
    path = credentials_file(alarms)
    urls = _urls_in(path)
    for name in alarms.addresses:
        if name not in urls:
            raise ConfigError(f"{path} has no address {name!r}, which alarms.addresses names; add a line `{name}: ADDRESS`")
    return [Address(name, urls[name]) for name in alarms.addresses]


def credentials_file(alarms: AlarmsConfig) -> Path:
    """Where the addresses stand: as configured, else in the credential of the unit, else where the unit has it from."""
    folder = os.environ.get("CREDENTIALS_DIRECTORY")
    return alarms.credentials or (Path(folder, CREDENTIAL) if folder else INSTALLED)


def _urls_in(path: Path) -> dict[str, str]:
    """The addresses of a file by their names; no error quotes what stands in it."""
    try:
        text = read_text(path)
        mode = path.stat().st_mode
    except (OSError, PalpdError):
        raise Refused(f"the addresses of alarms cannot be read from {path}; make that file, or run this as its owner") from None
    if mode & (stat.S_IROTH | stat.S_IWOTH):
        raise Refused(f"{path} holds secrets, and every user of this computer may read it; chmod o= {path}")
    try:
        content = parse_yaml(text, str(path)).content
    except ConfigError:
        content = None
    if not isinstance(content, dict) or not all(isinstance(item, str) for pair in content.items() for item in pair):
        raise ConfigError(f"{path} is not a list of lines `name: address`, such as phone: ntfys://ntfy.sh/topic; {PAGE}")
    return content


def _parts_of(url: str) -> list[str]:
    """Every part of an address but its kind, as it stands there and decoded, the longest first."""
    parts = re.split(r"[/:@?&=#,\s]+", url.partition("://")[2])
    both = {url, *parts, *map(unquote, parts)}
    return sorted((part for part in both if len(part) >= SHORTEST_SECRET), key=len, reverse=True)
