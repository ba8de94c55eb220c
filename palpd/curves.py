"""Force curves of other people's machines: read by naming the columns, judged for stiffness, turned into recordings."""

import csv
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from palpd.errors import BadInput, RecordingError
from palpd.samples import Samples, samples_from_columns, write_csv
from palpd.tick import Floats
from palpd.young import FEWEST_SAMPLES, ContactFit, fit_contact, modulus_peak_Pa

ForceUnit = Literal["N", "mN", "uN", "nN"]
LengthUnit = Literal["m", "mm", "um", "nm"]
FORCE_UNITS: dict[str, float] = {"N": 1.0, "mN": 1e-3, "uN": 1e-6, "nN": 1e-9}
LENGTH_UNITS: dict[str, float] = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9}
DELIMITERS = (",", ";", "\t")
OWN = ("fz_N", "z_m", "t_s")
"""Force, height and time of our own recordings, taken where no column is named."""
TARED_NAMES = ("corrected", "tared", "zeroed", "baselined")
"""Words in a column's name that say its baseline has already been taken out."""
TURNED = 0.2
"""Share of the travel that the tip must have come back for a new press to begin; less is noise or a pause."""


@dataclass(frozen=True)
class Mapping:
    """Which columns of a foreign file are force, depth (grows inwards) or height (falls downwards), and time, and their units."""

    force_column: str | None = None
    force_unit: ForceUnit = "N"
    depth_column: str | None = None
    height_column: str | None = None
    height_down_positive: bool = False
    length_unit: LengthUnit = "m"
    compression_negative: bool = False
    time_column: str | None = None


@dataclass(frozen=True)
class Curve:
    """One force curve in SI: `height_m` (n,) up positive, `force_N` (n,) compression positive, `t_s` (n,) or None.

    `sign` turns a height back onto the axis of the column it came from, `columns` names force and length columns, `skipped` counts
    the rows before and after the numbers (the header row is not one of them).
    """

    name: str
    height_m: Floats
    force_N: Floats
    t_s: Floats | None
    sign: float
    columns: tuple[str, str]
    skipped: int = 0

    def __len__(self) -> int:
        return len(self.force_N)


@dataclass(slots=True)
class _Table:
    """The numbers of the wanted columns (n, k), and the rows of the file, from 1, that they came from."""

    values: list[list[float]] = field(default_factory=list)
    skipped: int = 0


def read_curve(path: Path, mapping: Mapping) -> Curve:
    """A curve from a text file with a header row somewhere. Raises RecordingError naming column and row, BadInput for the mapping."""
    lines = _lines(path)
    force, length, time = _wanted(path, lines, mapping)
    wanted = [force, length] + ([time] if time is not None else [])
    at, delimiter = _header(path, lines, wanted)
    header = [cell.strip() for cell in next(csv.reader([lines[at]], delimiter=delimiter))]
    columns = [header.index(name) for name in wanted]
    table = _numbers(path, lines, at, delimiter, dict(zip(wanted, columns, strict=True)))
    if not table.values:
        raise RecordingError(
            f"{path.name}: no row below the header (row {at + 1}) has numbers in {', '.join(wanted)}; is it the right file?"
        )
    values = np.array(table.values)
    sign = -1.0 if mapping.depth_column is not None or mapping.height_down_positive else 1.0
    return Curve(
        name=path.name,
        height_m=sign * values[:, 1] * LENGTH_UNITS[mapping.length_unit],
        force_N=(-1.0 if mapping.compression_negative else 1.0) * values[:, 0] * FORCE_UNITS[mapping.force_unit],
        t_s=values[:, 2] if time is not None else None,
        sign=sign,
        columns=(force, length),
        skipped=table.skipped,
    )


def analyse_curve(
    curve: Curve,
    *,
    tip_radius_m: float,
    poisson_ratio: float = 0.5,
    machine_stiffness_N_per_m: float | None = None,
    fit: Literal["loading", "peak"] = "loading",
    contact: Literal["free", "zero"] = "free",
    baseline: Literal["auto", "free", "zero"] = "auto",
    thickness_m: float | None = None,
) -> dict[str, Any]:
    """Young's modulus of a curve with its interval, as the keys of the command line's JSON.

    `loading` fits Hertz to the last press up to its peak; `peak` takes the paper's equation 1 at the force peak, with contact point and
    baseline of that fit. `zero` holds the contact where the length column is zero. The baseline is free unless `zero`, or unless
    (`auto`) the force column's name says that it has been taken out; what the other choice gives is reported beside it.
    `contact_point_m` is on the axis of the length column. Raises RecordingError, and BadInput for a figure that cannot be.
    """
    _refuse_figures(tip_radius_m, poisson_ratio, machine_stiffness_N_per_m, thickness_m)
    first, last = _loading(curve)
    press = slice(first, last + 1)
    named_tared = any(word in curve.columns[0].lower() for word in TARED_NAMES)
    held = baseline == "zero" or (baseline == "auto" and named_tared)

    def fitted(held: bool) -> ContactFit:
        return fit_contact(
            curve.height_m[press],
            curve.force_N[press],
            tip_radius_m,
            poisson_ratio,
            machine_stiffness_N_per_m=machine_stiffness_N_per_m or math.inf,
            contact_m=0.0 if contact == "zero" else None,
            baseline_N=0.0 if held else None,
            thickness_m=thickness_m,
        )

    try:
        found, other = fitted(held), fitted(not held)
    except RecordingError as error:
        raise RecordingError(f"{curve.name}: {error}") from None
    warnings = list(found.warnings)
    if held and baseline == "auto":
        warnings.append(
            f"{curve.columns[0]} is named as tared, so its baseline is held at zero; left free it is {other.baseline_N:.3g} N and "
            f"E {other.youngs_modulus_Pa:.5g} Pa"
        )
    modulus, ci95 = found.youngs_modulus_Pa, found.ci95_Pa
    peak_N = float(curve.force_N[last]) - found.baseline_N
    if fit == "peak":
        # the interval of equation 1: of the contact point, of the baseline and of the one sample that is the peak
        modulus = modulus_peak_Pa(peak_N, found.depth_m, tip_radius_m, poisson_ratio)
        share = 1.96 * math.hypot(1.5 * found.contact_sigma_m / found.depth_m, found.rms_N / peak_N)
        ci95 = (modulus * (1.0 - share), modulus * (1.0 + share))
    return {
        "youngs_modulus_Pa": modulus,
        "ci95_Pa": list(ci95),
        "reduced_modulus_Pa": modulus / (1.0 - poisson_ratio**2),
        "contact_point_m": curve.sign * found.contact_point_m + 0.0,  # never -0.0
        "contact_sigma_m": found.contact_sigma_m,
        "baseline_N": found.baseline_N,
        "baseline": "zero" if held else "free",
        "other_baseline_youngs_modulus_Pa": other.youngs_modulus_Pa,
        "rms_N": found.rms_N,
        "depth_m": found.depth_m,
        "peak_force_N": peak_N,
        "fit": fit,
        "contact": contact,
        "machine_stiffness_N_per_m": machine_stiffness_N_per_m,
        "poisson_ratio": poisson_ratio,
        "tip_radius_m": tip_radius_m,
        "samples": found.n,
        "effective_samples": found.n_effective,
        "rows_skipped": curve.skipped,
        "warnings": warnings,
    }


def import_curve(path: Path, mapping: Mapping, csv_out: Path, *, overwrite: bool = False) -> Samples:
    """Write a foreign curve as a recording: height, its speed by differences, force on fz; no command, no other axis is known.

    Raises RecordingError, and BadInput where the file exists.
    """
    curve = read_curve(path, mapping)
    if curve.t_s is None:
        raise BadInput(f"a recording needs time and no column of {path.name} is named for it; give --time-column")
    if len(curve) < 2:
        raise RecordingError(f"{path.name} has {len(curve)} row of numbers; a recording needs many")
    t_s = curve.t_s - curve.t_s[0]
    still = np.flatnonzero(np.diff(t_s) <= 0)
    speed = np.gradient(curve.height_m, t_s) if not len(still) else np.zeros(len(curve))  # refused below, with the row named
    zeros = np.zeros(len(curve))
    columns = {"t_s": t_s, "z_m": curve.height_m, "vz_m_per_s": speed, "fx_N": zeros, "fy_N": zeros, "fz_N": curve.force_N}
    columns |= {"tx_Nm": zeros, "ty_Nm": zeros, "tz_Nm": zeros}
    samples = samples_from_columns(columns, path.name)
    write_csv(csv_out, samples, overwrite=overwrite)
    return samples


def _loading(curve: Curve) -> tuple[int, int]:
    """First and last sample of the way to the peak: the earlier of most force and most depth, back to where that press began."""
    last = min(int(np.argmax(curve.force_N)), int(np.argmin(curve.height_m)))
    backwards = curve.height_m[last::-1]
    fallen = np.maximum.accumulate(backwards) - backwards
    before = np.flatnonzero(fallen > TURNED * np.ptp(curve.height_m))
    first = last - int(np.argmax(backwards[: before[0]])) if len(before) else 0
    if last - first + 1 < FEWEST_SAMPLES:
        raise RecordingError(
            f"{curve.name}: only {last - first + 1} samples lead to the peak of force or depth, {FEWEST_SAMPLES} or more are needed; "
            "check the force's sign, the columns and the direction of the height"
        )
    return first, last


def _lines(path: Path) -> list[str]:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path.name} cannot be read ({error.strerror}); give a curve that exists") from None
    if b"\0" in content:
        raise RecordingError(f"{path.name} is not text; export the curve as CSV")
    try:
        return content.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        return content.decode("latin-1").splitlines()  # µ and ° in a header of an older instrument


def _wanted(path: Path, lines: list[str], mapping: Mapping) -> tuple[str, str, str | None]:
    """Names of the columns for force, length and time."""
    if mapping.depth_column is not None and mapping.height_column is not None:
        raise BadInput("--depth-column and --height-column were both given; give the one that the curve is to be judged by")
    if mapping.depth_column is not None and mapping.height_down_positive:
        raise BadInput("--height-down-positive belongs to --height-column; a depth always grows inwards")
    length = mapping.depth_column or mapping.height_column
    if mapping.force_column is None and length is None:
        own = [cell.strip() for cell in lines[0].split(",")] if lines else []
        if all(name in own for name in OWN):
            return OWN
    if mapping.force_column is None or length is None:
        missing = "--force-column" if mapping.force_column is None else "--depth-column or --height-column"
        raise BadInput(f"{missing} is missing: {path.name} is no recording of palpd, so name its columns ({_seen(lines)})")
    return mapping.force_column, length, mapping.time_column


def _header(path: Path, lines: list[str], wanted: list[str]) -> tuple[int, str]:
    """The line that names all wanted columns, and what parts its cells."""
    for at, line in enumerate(lines):
        for delimiter in DELIMITERS:
            cells = [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter), [])]
            if all(name in cells for name in wanted):
                twice = [name for name in wanted if cells.count(name) > 1]
                if twice:
                    raise RecordingError(f"{path.name}: column {twice[0]} stands twice in row {at + 1} (the header); rename one of them")
                return at, delimiter
    absent = [name for name in wanted if not any(name in line for line in lines)]
    raise RecordingError(
        f"{path.name}: no row names the column{'s' if len(wanted) > 1 else ''} {', '.join(absent or wanted)} ({_seen(lines)}); "
        "spell it as in the file"
    )


def _seen(lines: list[str]) -> str:
    """What looks most like a header: the first line with the most cells, none of them a number."""
    best: list[str] = []
    for line in lines:
        for delimiter in DELIMITERS:
            cells = [cell.strip() for cell in line.split(delimiter)]
            if len(cells) > len(best) and not any(map(_is_number, cells)):
                best = cells
    return f"the file has {', '.join(best)}"[:300] if best else "the file has no header row"


def _numbers(path: Path, lines: list[str], header: int, delimiter: str, columns: dict[str, int]) -> _Table:
    """Rows below the header with a number in every wanted column. Others may stand before and after them, not between."""
    table = _Table(skipped=sum(1 for line in lines[:header] if line.strip()))
    gap: tuple[int, str, str] | None = None
    for number, line in enumerate(lines[header + 1 :], start=header + 2):
        if not line.strip():
            continue
        cells = next(csv.reader([line], delimiter=delimiter))
        texts = {name: cells[at].strip() if at < len(cells) else "" for name, at in columns.items()}
        wrong = next((name for name, text in texts.items() if not _is_number(text)), None)
        if wrong is not None:
            table.skipped += 1
            if table.values and gap is None:
                gap = (number, wrong, texts[wrong])
            continue
        if gap is not None:
            row, name, text = gap
            raise RecordingError(
                f"{path.name}: {name} {f'is {text!r}' if text else 'is empty'} in row {row}, between rows of numbers; "
                "every value must be a finite number, so correct or remove that row"
            )
        table.values.append([float(text) for text in texts.values()])
    return table


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def _refuse_figures(radius_m: float, poisson_ratio: float, stiffness_N_per_m: float | None, thickness_m: float | None) -> None:
    if not 0.0 < radius_m < math.inf:
        raise BadInput(f"the tip radius is {radius_m:g} m, expected above zero; give it in metres (5 mm is 0.005)")
    if not 0.0 <= poisson_ratio <= 0.5:
        raise BadInput(f"Poisson's ratio is {poisson_ratio:g}, expected 0 to 0.5; rubber and soft tissue have nearly 0.5")
    for what, value in (("machine's stiffness", stiffness_N_per_m), ("thickness", thickness_m)):
        if value is not None and not 0.0 < value < math.inf:
            raise BadInput(f"the {what} is {value:g}, expected above zero in SI units; leave it out if it is not known")
