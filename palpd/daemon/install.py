"""Installs the files of the service: units, users, device rule, configuration."""

import re
import sys
from pathlib import Path

from palpd.errors import Refused
from palpd.files import check_folder, shipped, write_yaml

UNITS = ("palpd.service", "palpd-web.service", "palpd-stream.service", "palpd-alarms.service")
UNIT_PYTHON = "/opt/palpd/.venv/bin/python"
PATHS = "paths: {runs: /var/lib/palpd/runs, state: /var/lib/palpd, socket: /run/palpd/palpd.sock}"
UNSEEN = ("/root", "/home", "/run/user", "/tmp", "/var/tmp")
"""Folders that ProtectHome and PrivateTmp hide from the service."""
NEXT_STEPS = """\
Then, as root:
  systemd-sysusers && udevadm control --reload && udevadm trigger --subsystem-match=tty --subsystem-match=misc
  systemctl daemon-reload && systemctl enable --now palpd
  usermod --append --groups palpd OPERATOR      # who may speak to the daemon
  runuser -u palpd -- palpd calibrate --config /etc/palpd/config.yaml
  systemctl enable --now palpd-web              # the page, if you want it: docs/page.md
  systemctl enable --now palpd-alarms           # messages to people who are away: docs/how-to/alarms.md"""


def unit_python(prefix: Path) -> str:
    """Path of the Python that the unit starts: this one, or in a package's build root the one in /opt where the service cannot see this.

    Raises:
        Refused: Without a build root, the service could not see this Python.
    """
    for needed in (sys.executable, sys.base_prefix, __file__):
        if needed.startswith(tuple(f"{hidden}/" for hidden in UNSEEN)):
            if prefix != Path("/"):
                return UNIT_PYTHON
            raise Refused(f"{needed} is hidden from the service, which sees no home and no /tmp; set palpd up in /opt")
    return sys.executable


def installed(prefix: Path) -> list[Path]:
    """Copy the files below `prefix`, with the path of this Python in the units, and return the paths. An existing configuration stays.

    Raises:
        BadInput: A file cannot be written.
        Refused: The service could not see this Python, the files did not come with the code, or a folder cannot be made.
    """
    units = {name: shipped(f"systemd/{name}").read_text().replace(UNIT_PYTHON, unit_python(prefix)) for name in UNITS}
    config = re.sub(r"^paths:.*$", PATHS, shipped("config.yaml").read_text(), flags=re.MULTILINE)
    check_folder(prefix)
    texts = {
        **{f"etc/systemd/system/{name}": unit for name, unit in units.items()},
        "etc/sysusers.d/palpd.conf": shipped("systemd/palpd.sysusers.conf").read_text(),
        "etc/udev/rules.d/99-palpd-hex.rules": shipped("systemd/99-palpd-hex.rules").read_text(),
        "etc/palpd/config.yaml": config,
    }
    written = []
    for name, text in texts.items():
        path = prefix / name
        if path.name == "config.yaml" and path.exists():
            continue
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_yaml(path, text)
            path.chmod(0o644)
        except OSError as error:
            raise Refused(f"{path} cannot be written ({error.strerror}); run palpd install as root, or give --prefix") from error
        written.append(path)
    return written
