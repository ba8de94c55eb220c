"""Everything palpd raises on purpose. The text of each is one sentence: what was measured, what was expected, what to do.

PalpdError
├── BadInput          a file, key, flag or answer is wrong; nothing moved, nothing was written        exit 2
│   ├── ConfigError       config.yaml, plan.yaml or cell.yaml
│   ├── RecordingError    a recording or a foreign curve
│   └── ModelRefused      an inertial model without card, with wrong inputs, or of another probe
├── Refused           the cell is not in the state that the command needs (moving, loaded, untared)   exit 2
├── DeviceError       a device is absent, busy or answers wrongly before anything moved               exit 2
│   ├── RobotError
│   └── SensorError
└── Stopped           a run that had begun was ended by the guard or by a fault                       exit 3
"""

from collections.abc import Mapping


class PalpdError(Exception):
    """Root of the tree; `exit_code` is what the command line returns."""

    exit_code = 2


class BadInput(PalpdError):
    """What was given cannot be used; nothing has changed."""


class ConfigError(BadInput):
    """A configuration, plan or cell file is wrong, incomplete or unsafe. `faults` has a sentence for each wrong key, by its path."""

    def __init__(self, sentence: str, faults: Mapping[str, str] | None = None) -> None:
        super().__init__(sentence)
        self.faults = dict(faults or {})


class RecordingError(BadInput):
    """A recording or curve cannot be read or judged."""


class ModelRefused(BadInput):
    """An inertial model may not be used for this cell."""


class Refused(PalpdError):
    """The cell is not in the state that the command needs."""


class DeviceError(PalpdError):
    """A device is absent, busy, or not what it should be."""


class RobotError(DeviceError):
    """The robot's controller cannot be reached or is not ready."""


class SensorError(DeviceError):
    """The force sensor cannot be reached or is not what was configured."""


class Stopped(PalpdError):
    """A run was ended by the guard or by a fault."""

    exit_code = 3
