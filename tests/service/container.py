"""A Debian of its own in which systemd is process 1: an overlay of / in memory, booted by systemd-nspawn, driven from outside."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from tests.paths import ROOT

INSIDE_PYTHON = Path("/opt/python")
INSIDE_CODE = Path("/opt/palpd/code")
CAPABILITIES = "CAP_SYS_NICE,CAP_IPC_LOCK,CAP_SYS_RESOURCE"
CAP_SYS_RESOURCE = 24
BOOT_S = 60.0


def missing() -> str | None:
    """Why no container can be booted here, or None."""
    if os.geteuid() != 0:
        return "needs root"
    lacking = [tool for tool in ("systemd-nspawn", "nsenter", "mount", "systemctl") if shutil.which(tool) is None]
    return f"needs {', '.join(lacking)} (Debian: systemd-container)" if lacking else None


class Container:
    """A booted container; `run` executes a command in it and returns what it wrote."""

    def __init__(self, root: Path, leader: int) -> None:
        self.root, self.leader = root, leader

    def run(self, *command: str, check: bool = True, timeout_s: float = 60.0) -> str:
        """Carry out `command` inside; RuntimeError with its output if it fails."""
        inside = ["nsenter", "--all", "--target", str(self.leader), *command]
        environment = {"PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin", "LANG": "C.UTF-8"}
        done = subprocess.run(inside, capture_output=True, text=True, timeout=timeout_s, env=environment, cwd="/")
        if check and done.returncode:
            raise RuntimeError(f"{' '.join(command)} ended with {done.returncode}: {done.stdout}{done.stderr}")
        return done.stdout + done.stderr

    @property
    def raises_limits(self) -> bool:
        """Whether its systemd may raise a limit (CAP_SYS_RESOURCE), so that LimitRTPRIO= and LimitMEMLOCK= mean something."""
        held = next(line for line in self.path("/proc/1/status").read_text().splitlines() if line.startswith("CapEff:"))
        return bool(int(held.split()[1], 16) >> CAP_SYS_RESOURCE & 1)

    def shows(self, unit: str, name: str) -> str:
        """One property of a unit."""
        return self.run("systemctl", "show", "--value", "--property", name, unit).strip()

    def path(self, inside: str) -> Path:
        """The same file seen from outside."""
        return Path(f"/proc/{self.leader}/root{inside}")

    def write(self, inside: str, text: str) -> None:
        """A file inside, readable for all."""
        self.path(inside).parent.mkdir(parents=True, exist_ok=True)
        self.path(inside).write_text(text)


def until(true: Callable[[], bool], patience_s: float, what: str, every_s: float = 0.05) -> float:
    """Wait until `true()`, and return how many seconds that took; AssertionError after `patience_s`."""
    began_s = time.monotonic()
    while not true():
        if time.monotonic() - began_s > patience_s:
            raise AssertionError(f"{what}: not within {patience_s:g} s")
        time.sleep(every_s)
    return time.monotonic() - began_s


@contextlib.contextmanager
def booted(folder: Path) -> Iterator[Container]:
    """Boot, with this Python at /opt/python and this checkout at /opt/palpd/code, both read-only; ended and unmounted on leaving."""
    memory, root = folder / "memory", folder / "root"
    with contextlib.ExitStack() as undo:
        for path in (memory, root):
            path.mkdir()
        _mount("-t", "tmpfs", "tmpfs", str(memory))
        undo.callback(_unmount, memory)
        (memory / "upper").mkdir()
        (memory / "work").mkdir()
        _mount("-t", "overlay", "overlay", "-o", f"lowerdir=/,upperdir={memory}/upper,workdir={memory}/work", str(root))
        undo.callback(_unmount, root)
        _clear(root)
        command = [
            "systemd-nspawn", "--quiet", "--directory", str(root), "--boot", "--register=no", "--keep-unit", "--console=pipe",
            f"--capability={CAPABILITIES}", "--machine=palpd-test", "--private-network", f"--bind-ro={sys.base_prefix}:{INSIDE_PYTHON}",
            f"--bind-ro={ROOT}:{INSIDE_CODE}", "systemd.unit=multi-user.target",
        ]  # fmt: skip
        log = (folder / "boot.log").open("wb")
        undo.callback(log.close)
        nspawn = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT)
        undo.callback(_end, nspawn)
        container = Container(root, _leader(nspawn, folder / "boot.log"))
        until(lambda: _is_up(container), BOOT_S, "systemd in the container comes up")
        yield container


def _clear(root: Path) -> None:
    """Take out what the host's systemd would start, and what would be the host's identity."""
    for name in ("etc/machine-id", "var/lib/dbus/machine-id", "etc/resolv.conf"):
        (root / name).unlink(missing_ok=True)
    (root / "etc/machine-id").touch()
    for folder in ("etc/systemd/system", "etc/palpd", "var/lib/palpd", "var/log/journal", "opt/palpd", "opt/python"):
        shutil.rmtree(root / folder, ignore_errors=True)
    for folder in ("etc/systemd/system", "opt/palpd", "opt/python"):
        (root / folder).mkdir(parents=True)


def _leader(nspawn: "subprocess.Popen[bytes]", log: Path) -> int:
    """Process 1 of the container, as the host numbers it."""
    children = Path(f"/proc/{nspawn.pid}/task/{nspawn.pid}/children")
    leaders: list[int] = []

    def there() -> bool:
        if nspawn.poll() is not None:
            raise AssertionError(f"systemd-nspawn ended with {nspawn.returncode}: {log.read_text(errors='replace')}")
        for child in children.read_text().split():
            with contextlib.suppress(OSError):
                if Path(f"/proc/{child}/comm").read_text().strip() == "systemd":
                    leaders.append(int(child))
        return bool(leaders)

    until(there, BOOT_S, "systemd-nspawn starts systemd")
    return leaders[0]


def _is_up(container: Container) -> bool:
    try:
        return container.run("systemctl", "is-system-running", check=False).strip() in ("running", "degraded")
    except subprocess.TimeoutExpired:
        return False


def _end(nspawn: "subprocess.Popen[bytes]") -> None:
    nspawn.send_signal(signal.SIGTERM)  # powers the container off
    try:
        nspawn.wait(20.0)
    except subprocess.TimeoutExpired:
        nspawn.kill()
        nspawn.wait()


def _mount(*arguments: str) -> None:
    subprocess.run(["mount", *arguments], check=True, capture_output=True)


def _unmount(path: Path) -> None:
    subprocess.run(["umount", "--lazy", str(path)], check=False, capture_output=True)
