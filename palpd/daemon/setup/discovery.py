"""Which serial devices are DAQs of an OptoForce, by their USB identity."""

from pathlib import Path

from palpd.daemon.finding import text_of

USB_IDENTITY = ("04d8", "000a")
"""Vendor and product of the DAQ: Microchip's example of a CDC device, so another device may have the same."""
STABLE_NAME = Path("/dev/palpd-hex")
"""Name that the udev rule of `palpd install` makes."""


def sensor_ports(by_id: Path = Path("/dev/serial/by-id"), tty: Path = Path("/sys/class/tty"), named: Path = STABLE_NAME) -> list[Path]:
    """Find the ports of DAQs that are plugged in.

    Args:
        by_id: Folder of the names by identity.
        tty: Folder of the kernel's terminals.
        named: Stable name that the udev rule makes.

    Returns:
        Their names, which stay when other devices are plugged in; the udev rule's first.
    """
    links = sorted(by_id.iterdir()) if by_id.is_dir() else []
    return [*([named] if named.exists() else []), *(link for link in links if _identity(tty / link.resolve().name) == USB_IDENTITY)]


def _identity(terminal: Path) -> tuple[str | None, str | None]:
    device = (terminal / "device").resolve().parent  # the terminal belongs to an interface of the USB device
    return text_of(str(device / "idVendor")), text_of(str(device / "idProduct"))
