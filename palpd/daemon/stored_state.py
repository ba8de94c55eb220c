"""What survives a restart: reference tare, stiffness, last check, latch, protective stops, unfinished contact. One JSON file each."""

import datetime
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

from pydantic import TypeAdapter, ValidationError

from palpd.control.plan_place import PlanPlace
from palpd.control.probe_state import ContactMarker, LevelTested, ProbeIdentity
from palpd.daemon.robot_stops import Date, ProtectiveStops
from palpd.daemon.setup.commission import Commission
from palpd.documents import read_json
from palpd.errors import BadInput, ConfigError, Refused
from palpd.files import write_json

MOST_BYTES = 100_000
"""Largest file of state; each holds a few numbers and a sentence."""


SOFTEST_N_PER_M = 1e4
"""Least stiffness of a machine whose screws are tight (assumed): at 12 N it gives way by 1.2 mm."""


Basis = Literal["unconfirmed", "free", "level", "yes"]
"""Why a reference is believed: first of its folder, within the drift of the one before, by a level test, or by an operator's word."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """Reference tare: `wrench` (6,) in the sensor's axes, N and Nm, of a free, still probe on that date by that sensor.

    `first` (6,) is the tare that an operator's yes may move away from by 3 N at most. `away_N` is the force off the reference before, as
    the operator `by` saw it.
    """

    wrench: tuple[float, ...]
    date: str
    sensor_serial: str | None
    temperature_C: float | None = None
    probe: tuple[float, ...] | None = None
    tcp: tuple[float, ...] | None = None
    tilt_rad: float | None = None
    first: tuple[float, ...] | None = None
    basis: Basis = "unconfirmed"
    by: str = ""
    away_N: float | None = None

    @property
    def identity(self) -> ProbeIdentity:
        """What the tare belongs to."""
        return ProbeIdentity(self.sensor_serial, self.probe, self.tcp)


@dataclass(frozen=True, slots=True)
class MachineStiffness:
    """How stiff sensor, mount and arm are together, from pressing a rigid plate."""

    stiffness_N_per_m: float
    ci95_N_per_m: tuple[float, float]
    date: str
    sensor_serial: str | None

    @property
    def too_soft(self) -> str:
        """Why no run may count with it; empty where it may. A machine that counts as too soft makes every press deeper than commanded."""
        if self.stiffness_N_per_m >= SOFTEST_N_PER_M:
            return ""
        return (
            f"{self.stiffness_N_per_m / 1e3:.3g} N for 1 mm, expected at least {SOFTEST_N_PER_M / 1e3:g} N of a machine on a rigid plate; "
            "tighten the screws of sensor, mount and probe, put a rigid plate on firm ground under the probe, and repeat palpd stiffness"
        )


@dataclass(frozen=True, slots=True)
class Latch:
    """Why the last run was stopped; while it stands nothing is armed."""

    reason: str
    date: str


@dataclass(frozen=True, slots=True)
class LastCheck:
    """How the last morning check ended: its date, its level (`ok`, `warn`, `stop`; `open` until it has ended), and its sentence.

    `number` is that of the last check that was kept in a folder of runs, also where that folder is another one by now; 0: not known.
    """

    date: Date
    level: Literal["ok", "warn", "stop", "open"]
    sentence: str
    number: int = 0


Stored = Calibration | MachineStiffness | LastCheck | Latch | ContactMarker | LevelTested | PlanPlace | ProtectiveStops | Commission
"""What a state file holds."""
Kept = TypeVar("Kept", bound=Stored)
_ADAPTERS: dict[str, TypeAdapter[Any]] = {}
"""What reads each file: one takes 10 ms to make, and the service reads these files several times a second."""


def now() -> str:
    """Date and time with time zone, ISO 8601."""
    return datetime.datetime.now().astimezone().isoformat(timespec="seconds")


class State:
    """The folder that these are kept in; made when first written to."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def calibration(self) -> Calibration | None:
        """The last `palpd calibrate`, if any."""
        calibration = self._kept("calibration", Calibration, "no reference tare; delete it, and run palpd calibrate again")
        if calibration is not None and (len(calibration.wrench) != 6 or not all(map(math.isfinite, calibration.wrench))):
            raise ConfigError(f"{self.folder / 'calibration.json'} holds no reference tare; delete it, and run palpd calibrate again")
        return calibration

    def marker(self) -> ContactMarker | None:
        """The contact that no run has finished, if any."""
        return self._kept(
            "contact", ContactMarker, "no contact that can be read; free the probe at the pendant, delete it, and run palpd level-test"
        )

    def level(self) -> LevelTested | None:
        """The last level test that found the probe free, if nothing has moved since."""
        return self._kept("level", LevelTested, "no level test; delete it")

    def machine_stiffness(self) -> MachineStiffness | None:
        """The last `palpd stiffness`, if any. Raises ConfigError where the file is damaged, or its machine is too soft to be one."""
        damaged = "no stiffness of the machine; run palpd stiffness again"
        stiffness = self._kept("stiffness", MachineStiffness, damaged)
        numbers = (stiffness.stiffness_N_per_m, *stiffness.ci95_N_per_m) if stiffness is not None else (1.0,)
        if numbers[0] <= 0.0 or not all(map(math.isfinite, numbers)):
            raise ConfigError(f"{self.folder / 'stiffness.json'} holds {damaged}")
        if stiffness is not None and stiffness.too_soft:
            raise ConfigError(f"{self.folder / 'stiffness.json'} holds {stiffness.too_soft}")
        return stiffness

    def commission(self) -> Commission:
        """What `palpd setup` has done so far; empty where it has not begun."""
        return self._kept("commission", Commission, "no commission; delete it, and begin palpd setup again") or Commission()

    def last_check(self) -> LastCheck | None:
        """The last `palpd check`, if any."""
        return self._kept("check", LastCheck, "no check; delete it, and run palpd check again")

    def latch(self) -> Latch | None:
        """The reason of a stop that no operator has cleared; a file that cannot be read is one too. None where there is none."""
        try:
            return self._kept("latch", Latch, "no latch")
        except ConfigError:
            return Latch(f"the reason kept in {self.folder / 'latch.json'} cannot be read", "an unknown date")

    def place(self) -> PlanPlace | None:
        """Where the sites of the last palpation counted from."""
        return self._kept("place", PlanPlace, "no place of a plan; delete it, and start where the sites shall count from")

    def protective_stops(self) -> ProtectiveStops:
        """The last protective stops of the robot; a file that cannot be read asks for a cause."""
        try:
            return self._kept("protective", ProtectiveStops, "no protective stops") or ProtectiveStops()
        except ConfigError:
            path = self.folder / "protective.json"
            return ProtectiveStops(
                damaged=f"the protective stops kept in {path} cannot be read, so the cause of the last one must be written down"
            )

    def keep(self, name: str, thing: Stored) -> None:
        """Write a state file so that a crash leaves the old file or the new one, never half of it.

        Args:
            name: Name of the file, without `.json`.

        Raises:
            Refused: The file cannot be written.
        """
        path = self.folder / f"{name}.json"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_json(path, asdict(thing), own=True)
        except OSError as error:
            raise Refused(f"{path} cannot be written ({error.strerror}); make room there, or run as the service's user") from error
        except BadInput as error:
            raise Refused(f"{error}; make room there, or run as the service's user") from error

    def clear_latch(self) -> None:
        """Clear the latch, which only an operator may do."""
        self.forget("latch")

    def holds(self, name: str) -> bool:
        """Whether there is a state file of that name, readable or not."""
        return (self.folder / f"{name}.json").exists()

    def forget(self, name: str) -> None:
        """Remove a state file, if it is there. Raises Refused where it cannot be removed."""
        path = self.folder / f"{name}.json"
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise Refused(
                f"{path} cannot be removed ({error.strerror}); run as the service's user, on a disk that can be written"
            ) from error

    def put_back(self, name: str, before: Stored | None) -> None:
        """Leave a state file as it was.

        Args:
            name: Name of the file, without `.json`.
            before: What it held; None: there was none.

        Raises:
            Refused: The file cannot be written or removed.
        """
        if before is None:
            self.forget(name)
        else:
            self.keep(name, before)

    def _kept(self, name: str, kind: type[Kept], damaged: str) -> Kept | None:
        values = self._read(name)
        if name not in _ADAPTERS:
            _ADAPTERS[name] = TypeAdapter(kind)
        try:
            return None if values is None else cast(Kept, _ADAPTERS[name].validate_python(values))
        except ValidationError as error:
            raise ConfigError(f"{self.folder / f'{name}.json'} holds {damaged}") from error

    def _read(self, name: str) -> dict[str, Any] | None:
        path = self.folder / f"{name}.json"
        try:
            values = read_json(path, most_bytes=MOST_BYTES, error=ConfigError)
        except ConfigError as error:
            if isinstance(error.__cause__, FileNotFoundError):
                return None
            raise ConfigError(f"{error}; delete it and repeat the step that makes it") from error
        if not isinstance(values, dict):
            raise ConfigError(f"{path} holds no record; delete it and repeat the step that makes it")
        return values
