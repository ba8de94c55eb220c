"""Units of foreign files: what a name says, what a size says, and the factor to SI.

A unit that is guessed is shown and never applied before the user has confirmed it.
"""

import re
from dataclasses import dataclass
from math import pi
from typing import Literal

import numpy as np

from palpd.cell.plausible import PLAUSIBLE
from palpd.errors import BadInput
from palpd.tick import Floats

Quantity = Literal["force", "length", "time", "torque", "speed", "angle", "angular speed"]

POUND_N = 0.45359237 * 9.80665
FACTORS: dict[Quantity, dict[str, float]] = {
    "force": {
        "N": 1.0, "cN": 1e-2, "mN": 1e-3, "uN": 1e-6, "nN": 1e-9, "pN": 1e-12, "kN": 1e3, "kip": 1e3 * POUND_N, "lbf": POUND_N,
        "gf": 9.80665e-3, "kgf": 9.80665,
    },
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "in": 0.0254},
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
    "torque": {"Nm": 1.0, "mNm": 1e-3, "Nmm": 1e-3, "Ncm": 1e-2},
    "angle": {"rad": 1.0, "mrad": 1e-3, "deg": pi / 180.0, "rev": 2.0 * pi},
    "angular speed": {"rad/s": 1.0, "deg/s": pi / 180.0, "rpm": pi / 30.0},
    "speed": {"m/s": 1.0, "mm/s": 1e-3, "um/s": 1e-6, "nm/s": 1e-9},
}  # fmt: skip
"""Factor of every unit to the SI unit of its quantity, which stands first."""
VOLTS = {"V": 1.0, "mV": 1e-3}
SPELLINGS = {
    "newton": "N", "newtons": "N", "kn": "kN", "kips": "kip", "lb": "lbf", "lbs": "lbf", "g": "gf", "gram": "gf",
    "grams": "gf", "kg": "kgf", "inch": "in", "inches": "in", "micron": "um",
    "microns": "um", "sec": "s", "secs": "s", "second": "s", "seconds": "s", "volt": "V", "volts": "V", "m_per_s": "m/s", "m s^-1": "m/s",
    "m*s^-1": "m/s", "degrees": "deg", "degree": "deg", "°": "deg", "radian": "rad", "radians": "rad", "°/s": "deg/s",
    "rad_per_s": "rad/s", "N m": "Nm", "N*m": "Nm", "N·m": "Nm",
}  # fmt: skip
"""Other spellings of units."""
OPTIONS: dict[Quantity, str] = {
    "force": "--force-unit", "torque": "--force-unit", "length": "--length-unit", "angle": "--length-unit", "time": "--time-unit",
}  # fmt: skip
BRACKETED = re.compile(r"[(\[{]\s*([^()\[\]{}]+?)\s*[)\]}]\s*$")
APPENDED = re.compile(r"[_\s,/]\s*([A-Za-zµμ]+)$")

PER_SECOND = re.compile(r"[_\s,]\s*([a-zµμ]*m|rad|deg)(?:_per_|/)s$")
NOT_APPENDED = ("in", "min")
"""Units that end a name only in brackets: "force_min" is a minimum."""

LARGEST_TURN_RAD = 20.0
"""Range of an angle without a unit above which it is in degrees: three turns of a joint."""
SLOWEST_STEP_S = 0.5
"""Time step above which a column of time without a unit is in ms, µs or ns: recordings have 5 to 2000 Hz."""


@dataclass(frozen=True)
class UnitScale:
    """How the numbers of a column become SI: unit, factor, and where the unit comes from."""

    column: str
    quantity: Quantity
    unit: str
    factor: float
    source: Literal["given", "stated", "guessed", "assumed"]

    def __str__(self) -> str:
        reasons = {
            "given": "as given",
            "stated": "as the file states",
            "guessed": "guessed and confirmed",
            "assumed": "assumed, the file states no unit",
        }
        return f"{self.column}: {self.quantity} in {self.unit} ({reasons[self.source]})"


def unit_named(name: str, unit: str = "") -> str | None:
    """The unit that a column's name ends with, or that the file states beside it.

    Args:
        name: Name of the column, such as "F (mN)" or "depth_um".

    Returns:
        The unit as `FACTORS` and `VOLTS` spell it, or None.
    """
    bracketed, appended = BRACKETED.search(name), APPENDED.search(name)
    ending = appended.group(1) if appended and appended.group(1).lower() not in NOT_APPENDED else ""
    if not unit.strip() and not bracketed and (speed := PER_SECOND.search(name)):
        ending = f"{speed.group(1)}/s"
    text = unit.strip() or (bracketed.group(1) if bracketed else ending)
    plain = text.strip("()[]{} ").replace("µ", "u").replace("μ", "u")
    plain = SPELLINGS.get(plain, SPELLINGS.get(plain.lower(), plain))
    if plain in VOLTS or any(plain in units for units in FACTORS.values()):
        return plain
    return plain.lower() if plain.lower() in ("kip", "lbf", "mm", "cm") else None  # in capitals no other unit


def unknown_unit(name: str, unit: str = "") -> str:
    """What stands in the place of a unit and is none that palpd knows; empty otherwise.

    Args:
        name: Name of the column, such as "Force (cps)".
        unit: Unit that the file states beside it.
    """
    bracketed = BRACKETED.search(name)
    text = unit.strip() or (bracketed.group(1) if bracketed else "")
    return text if unit_named(name, unit) is None and any(letter.isalpha() for letter in text) else ""


def scale_of(
    column: str, quantity: Quantity, values: Floats, *, stated: str = "", given: str | None = None, per_volt: float | None = None
) -> UnitScale:
    """Find the unit of a column.

    Args:
        values: Its numbers (n,).
        stated: Unit that the file states beside the name.
        given: Unit that the user gave, or None.
        per_volt: SI units per volt, or None.

    Returns:
        The scale; its source says whether it must be confirmed.

    Raises:
        BadInput: The unit is unknown or belongs to another quantity, or volts come without their factor.
    """
    named = unit_named(column, stated)
    unit = given or named
    if unit in VOLTS:
        if per_volt is None:
            option = {"force": "--force-N-per-V", "length": "--length-m-per-V"}.get(quantity, "a column in another unit")
            raise BadInput(f"column {column} is in {unit}; give {option}, the factor of the amplifier")
        return UnitScale(column, quantity, unit, VOLTS[unit] * per_volt, "given")
    units = FACTORS[quantity]
    if given is not None:
        if given not in units:
            joint = any(given in FACTORS[of_joint] for of_joint in ("angle", "torque"))
            raise BadInput(
                f"{given} is given for column {column}, expected a {quantity} in {', '.join(units)}; correct the unit"
                f"{', or give --joint, if these are angle and torque of a joint' if joint else ''}"
            )
        return UnitScale(column, quantity, given, units[given], "given")
    if named is not None and named not in units:
        joint = quantity in ("length", "force") and any(named in FACTORS[of_joint] for of_joint in ("angle", "torque"))
        instead = "--joint, if these are angle and torque of a joint" if joint else OPTIONS.get(quantity, "its unit in the name")
        raise BadInput(
            f"column {column} is in {named}, expected a {quantity} in {', '.join(units)}; name another column, or give {instead}"
        )
    si = next(iter(units))
    if named is not None:
        return UnitScale(column, quantity, named, units[named], "stated" if named == si else "guessed")
    size = _size_guess(quantity, values)
    return UnitScale(column, quantity, size or si, units[size or si], "guessed" if size or unknown_unit(column, stated) else "assumed")


def _size_guess(quantity: Quantity, values: Floats) -> str | None:
    """The unit in which numbers of this size would be usual; None where SI is."""
    if quantity == "angle":
        return "deg" if len(values) and float(np.ptp(values)) > LARGEST_TURN_RAD else None
    if quantity == "length":
        span = float(np.ptp(values)) if len(values) else 0.0
        return None if span <= PLAUSIBLE["stroke"].high else "mm" if span <= 1e3 else "um" if span <= 1e5 else "nm"
    if quantity == "force":
        peak = float(np.abs(values).max()) if len(values) else 0.0
        return None if peak <= PLAUSIBLE["force"].high else "uN" if peak <= 1e9 else "nN"
    if quantity == "time" and len(values) > 1:
        step = float(np.median(np.diff(values)))
        return None if step <= SLOWEST_STEP_S else "ms" if step <= 200.0 else "us" if step <= 2e5 else "ns"
    return None


def refuse_unconfirmed(scales: list[UnitScale], confirmed: bool, name: str) -> None:
    """Refuse units that were guessed and not confirmed, all of them in one sentence.

    Args:
        scales: Units of the columns.
        confirmed: Whether the user has confirmed the guesses.

    Raises:
        BadInput: A guess is not confirmed.
    """
    guesses = [scale for scale in scales if scale.source == "guessed"]
    if guesses and not confirmed:
        shown = ", ".join(f"{scale.column} is a {scale.quantity} in {scale.unit}" for scale in guesses)
        options = " and ".join(dict.fromkeys(f"{OPTIONS[each.quantity]} {each.unit}" for each in guesses if each.quantity in OPTIONS))
        explicit = f", or give {options}" if options else ""
        raise BadInput(f"{name}: palpd guesses that {shown}; repeat the command with --units confirmed if that is right{explicit}")
