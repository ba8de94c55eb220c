"""Force curves of other people's machines: read by naming the columns, and judged for stiffness."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypedDict

import numpy as np

from palpd.analysis.hertz_misfit import HertzMisfit, covering, range_of
from palpd.analysis.young import ContactFit, equation_1_notes, fit_contact, modulus_hertz_Pa, modulus_peak_Pa, refuse_undetermined
from palpd.control.surface import FEWEST_SAMPLES
from palpd.errors import BadInput, RecordingError
from palpd.files import opened
from palpd.recording.oddities import fall_where_lowest_N
from palpd.recording.samples import LARGEST, SITE_COLUMN, refuse_mixed_sites, refuse_values
from palpd.recording.tables import DELIMITERS, cells_of, is_comment, refuse_decimal_commas
from palpd.tick import Floats

ForceUnit = Literal["N", "mN", "uN", "nN"]
LengthUnit = Literal["m", "mm", "um", "nm"]
FORCE_UNITS: dict[str, float] = {"N": 1.0, "mN": 1e-3, "uN": 1e-6, "nN": 1e-9}
LENGTH_UNITS: dict[str, float] = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9}
OWN = ("fz_N", "z_m", "t_s")
"""Force, height and time of our own recordings, taken where no column is named; the time also where force and height are named so."""
PLACE = ("x_m", "y_m")
"""Where the tip is, as `palpd export` names it: read where a file has both, to tell whether one place was pressed."""
TARED_NAMES = ("corrected", "tared", "zeroed", "baselined")
"""Words in a column's name that say its baseline has already been taken out."""
NEAR_PEAK = 0.98
"""Share of the full depth from which samples show the force at the peak: a force in d² there is 0.5 % from one in d^1.5."""
TURNED = 0.2
"""Share of the travel that the tip must have come back for a new press to begin; less is noise or a pause."""


ODD_TIP_M = (1e-8, 0.1)
"""Tip radii that no warning questions: from the tip of an atomic force microscope to a hand-sized sphere."""
ODD_DEPTH_M, ODD_DEPTH_RADII = 0.1, 3.0
"""Depth above which a warning asks for the unit of length; also one above that number of tip radii, where no sphere is left."""


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

    `sign` turns a height back onto the axis of the column it came from, `columns` names force and length columns, `below` is what stands
    below these names. `skipped` counts the rows before and after the numbers (the header row is not one of them). `place_m` (n, 2) is
    where the tip was, or None.
    """

    name: str
    height_m: Floats
    force_N: Floats
    t_s: Floats | None
    sign: float
    columns: tuple[str, str]
    below: tuple[str, str] = ("", "")
    skipped: int = 0
    place_m: Floats | None = None

    def __len__(self) -> int:
        return len(self.force_N)


@dataclass(slots=True)
class _Table:
    """The numbers of the columns that a mapping names (n, k), and how many rows were skipped."""

    values: list[list[float]] = field(default_factory=list)
    skipped: int = 0


def read_curve(path: Path, mapping: Mapping) -> Curve:
    """Read a curve from a text file with a header row somewhere.

    Args:
        mapping: Columns, units and directions of the curve.

    Returns:
        The curve, in N and m, heights up positive.

    Raises:
        RecordingError: A column is missing or a row cannot be read; the sentence names both. Or there are several sites.
        BadInput: The mapping contradicts itself or the file.
    """
    lines = _lines(path)
    force, length, time = _column_names(path, lines, mapping)
    names = [force, length] + ([time] if time is not None else [])
    if len(set(names)) < len(names):
        raise BadInput(f"one column is named for two of force, length and time ({', '.join(names)}); name one for each")
    at, delimiter = _header(path, lines, names)
    header = cells_of(lines[at], delimiter)
    if SITE_COLUMN in header:
        site = header.index(SITE_COLUMN)
        rows = (cells_of(line, delimiter) for line in lines[at + 1 :] if not is_comment(line))
        refuse_mixed_sites((row[site] for row in rows if site < len(row)), f"{path.name} holds")
    places = list(PLACE) if set(PLACE) <= set(header) - set(names) else []
    table = _numbers(path, lines, at, delimiter, {name: header.index(name) for name in [*names, *places]})
    if not table.values:
        raise RecordingError(
            f"{path.name}: no row below the header (row {at + 1}) has numbers in {', '.join(names)}; is it the right file?"
        )
    values = np.array(table.values)
    if names == list(OWN):  # other machines may round their time, and nothing but an import needs it
        refuse_values({"t_s": values[:, 2]}, path.name)
    sign = -1.0 if mapping.depth_column is not None or mapping.height_down_positive else 1.0
    below = dict(zip(header, cells_of(lines[at + 1], delimiter), strict=False))
    return Curve(
        name=path.name,
        height_m=sign * values[:, 1] * LENGTH_UNITS[mapping.length_unit],
        force_N=(-1.0 if mapping.compression_negative else 1.0) * values[:, 0] * FORCE_UNITS[mapping.force_unit],
        t_s=values[:, 2] if time is not None else None,
        sign=sign,
        columns=(force, length),
        below=(below.get(force, ""), below.get(length, "")),
        skipped=table.skipped,
        place_m=values[:, -2:] if places else None,
    )


class CurveResult(TypedDict):
    """Young's modulus of a curve, with the keys of the command line's JSON."""

    youngs_modulus_Pa: float
    ci95_Pa: list[float]
    hertz_misfit: HertzMisfit | None
    reduced_modulus_Pa: float
    contact_point_m: float
    contact_sigma_m: float
    baseline_N: float
    baseline: Literal["free", "zero"]
    other_baseline_youngs_modulus_Pa: float
    rms_N: float
    depth_m: float
    peak_force_N: float
    fit: Literal["loading", "peak"]
    contact: Literal["free", "zero"]
    machine_stiffness_N_per_m: float | None
    poisson_ratio: float
    tip_radius_m: float
    samples: int
    effective_samples: float
    rows_skipped: int
    warnings: list[str]


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
) -> CurveResult:
    """Young's modulus of a curve with its interval.

    Args:
        tip_radius_m: Radius of the spherical tip.
        poisson_ratio: Poisson's ratio of the tissue.
        machine_stiffness_N_per_m: Stiffness of the machine in series with the tissue, or None for rigid.
        fit: `loading` fits Hertz to the press with the largest force, up to its peak; `peak` takes the paper's equation 1 at that peak,
            with contact point and baseline of that fit.
        contact: `zero` holds the contact where the length column is zero.
        baseline: Force before contact: fitted, zero, or (`auto`) zero where the force column's name says that it was taken out.
        thickness_m: Thickness of the tissue, or None; it only decides on a warning.

    Returns:
        The modulus, and beside it the modulus that the other choice of baseline gives. `contact_point_m` is on the axis of the length
        column.

    Raises:
        RecordingError: The curve shows no contact or too few samples, the force falls with depth, several places were pressed,
            or the modulus may be zero.
        BadInput: A number is impossible.
    """
    _refuse_figures(tip_radius_m, poisson_ratio, machine_stiffness_N_per_m, thickness_m)
    if fall_N := fall_where_lowest_N(curve.height_m, curve.force_N):
        raise RecordingError(
            f"{curve.name}: the force falls by {fall_N:.3g} N where the tip is lowest, expected to rise; check the sign of the force "
            "(--compression-negative) and the direction of the height (--height-column, --depth-column, --height-down-positive)"
        )
    _refuse_several_places(curve, tip_radius_m)
    first, last = _loading(curve)
    held = baseline == "zero" or (baseline == "auto" and any(word in curve.columns[0].lower() for word in TARED_NAMES))
    machine = machine_stiffness_N_per_m or math.inf

    def fitted(held: bool) -> ContactFit:
        return fit_contact(
            curve.height_m[first : last + 1],
            curve.force_N[first : last + 1],
            tip_radius_m,
            poisson_ratio,
            machine_stiffness_N_per_m=machine,
            contact_m=0.0 if contact == "zero" else None,
            baseline_N=0.0 if held else None,
            thickness_m=thickness_m,
        )

    try:
        hertz, other = fitted(held), fitted(not held)
        peak_N, peak_sigma_N = _peak_N(curve.height_m[first : last + 1], curve.force_N[first : last + 1], hertz, machine)
        modulus, ci95 = hertz.youngs_modulus_Pa, hertz.ci95_Pa
        if by_peak := fit == "peak":
            modulus, ci95 = _at_peak(hertz, peak_N, peak_sigma_N, tip_radius_m, poisson_ratio)
        tested = (modulus, ci95) if hertz.misfit else (hertz.youngs_modulus_Pa, hertz.ci95_Pa)  # a peak of noise has a small interval
        refuse_undetermined(*tested, hertz.misfit)
    except RecordingError as error:
        raise RecordingError(f"{curve.name}: {error}") from None
    return {
        "youngs_modulus_Pa": modulus,
        "ci95_Pa": list(ci95),
        "hertz_misfit": hertz.misfit,
        "reduced_modulus_Pa": modulus / (1.0 - poisson_ratio**2),
        "contact_point_m": curve.sign * hertz.contact_point_m + 0.0,  # never -0.0
        "contact_sigma_m": hertz.contact_sigma_m,
        "baseline_N": hertz.baseline_N,
        "baseline": "zero" if held else "free",
        "other_baseline_youngs_modulus_Pa": other.youngs_modulus_Pa,
        "rms_N": hertz.rms_N,
        "depth_m": hertz.depth_m,
        "peak_force_N": peak_N,
        "fit": fit,
        "contact": contact,
        "machine_stiffness_N_per_m": machine_stiffness_N_per_m,
        "poisson_ratio": poisson_ratio,
        "tip_radius_m": tip_radius_m,
        "samples": hertz.n,
        "effective_samples": hertz.n_effective,
        "rows_skipped": curve.skipped,
        "warnings": [
            *_of_several(curve, first, last),
            *(equation_1_notes(poisson_ratio, "equation 1 is", " (--fit loading)") if by_peak else []),
            *_warnings(curve, hertz, tip_radius_m, other if held and baseline == "auto" else None),
        ],
    }


def _warnings(curve: Curve, hertz: ContactFit, tip_radius_m: float, fitted_baseline: ContactFit | None) -> list[str]:
    """What is odd about a curve and its fit; `fitted_baseline` is the other fit where the baseline was taken for zero unasked."""
    return [
        *_odd_lengths(curve, hertz.depth_m, tip_radius_m),
        *([] if hertz.misfit is None else [hertz.misfit["sentence"]]),
        *hertz.warnings,
        *([] if fitted_baseline is None else [_baseline_warning(curve, fitted_baseline)]),
    ]


def _of_several(curve: Curve, first: int, last: int) -> list[str]:
    """A sentence where the tip goes down more than once: to half of its way, after it was in the upper third again."""
    travelled = (curve.height_m.max() - curve.height_m) / np.ptp(curve.height_m)
    marks = np.where(travelled > 0.5, 1, np.where(travelled < 1.0 / 3.0, -1, 0))
    presses = int(np.sum(np.diff(marks[marks != 0], prepend=-1) > 0))
    if presses < 2:
        return []
    return [f"the curve holds {presses} presses, and E is that of the way down in samples {first + 1} to {last + 1} alone"]


def _odd_lengths(curve: Curve, depth_m: float, tip_radius_m: float) -> list[str]:
    """Warnings about a tip radius or a depth that looks like another unit."""
    warnings = []
    if not ODD_TIP_M[0] <= tip_radius_m <= ODD_TIP_M[1]:
        warnings.append(f"a tip radius of {tip_radius_m:g} m is unusual; --tip-radius-m is in metres (5 mm is 0.005)")
    if depth_m > ODD_DEPTH_M or depth_m > ODD_DEPTH_RADII * tip_radius_m:
        warnings.append(
            f"the depth of {depth_m:.3g} m is {depth_m / tip_radius_m:.3g} tip radii; check --length-unit of {curve.columns[1]} and the "
            "tip radius"
        )
    return warnings


def _baseline_warning(curve: Curve, other: ContactFit) -> str:
    return (
        f"{curve.columns[0]} is named as tared, so its baseline is held at zero; left free it is {other.baseline_N:.3g} N and "
        f"E {other.youngs_modulus_Pa:.5g} Pa"
    )


def _peak_N(height_m: Floats, force_N: Floats, hertz: ContactFit, machine_stiffness_N_per_m: float) -> tuple[float, float]:
    """Force at full depth and its standard deviation, from all samples near it: the largest sample alone is the peak of the noise too."""
    depth_m = hertz.contact_point_m - height_m - (force_N - hertz.baseline_N) / machine_stiffness_N_per_m
    near = depth_m >= NEAR_PEAK * depth_m.max()
    above_N = (force_N - hertz.baseline_N - hertz.tilt_N_per_m * depth_m)[near] * (hertz.depth_m / depth_m[near]) ** 1.5
    return float(above_N.mean()), hertz.rms_N / math.sqrt(max(len(above_N) * hertz.n_effective / hertz.n, 1.0))


def _at_peak(
    hertz: ContactFit, peak_N: float, sigma_N: float, tip_radius_m: float, poisson_ratio: float
) -> tuple[float, tuple[float, float]]:
    """Modulus of equation 1 and its interval: of the contact point, of the baseline and of the force at the peak."""
    modulus = modulus_peak_Pa(peak_N, hertz.depth_m, tip_radius_m, poisson_ratio)
    share = 1.96 * math.hypot(1.5 * hertz.contact_sigma_m / hertz.depth_m, sigma_N / peak_N)
    factor = modulus_peak_Pa(1.0, 1.0, 1.0, poisson_ratio) / modulus_hertz_Pa(
        1.0, 1.0, 1.0, poisson_ratio
    )  # the two differ where ν is not 0.5
    ranges_Pa = [(low_Pa * factor, high_Pa * factor) for low_Pa, high_Pa in range_of(hertz.misfit)]
    low_Pa, high_Pa = covering((modulus * (1.0 - share), modulus * (1.0 + share)), *ranges_Pa)
    return modulus, (low_Pa, high_Pa)


def refuse_unknown_tip(tip_radius_m: float | None) -> float:
    """The radius of the tip that made a curve, which no curve tells. Raises BadInput where it is not given."""
    if tip_radius_m is None:
        raise BadInput("--tip-radius-m is missing: a curve does not tell which tip made it; give its radius in metres")
    return tip_radius_m


def _loading(curve: Curve) -> tuple[int, int]:
    """First and last sample of the way to the largest force. A press in which the recording begins has no such way; a later one may."""
    first, last = _way_down(curve, 0)
    if last - first + 1 < FEWEST_SAMPLES:
        first, last = _way_down(curve, last + int(np.argmax(curve.height_m[last:])))
    if last - first + 1 < FEWEST_SAMPLES:
        raise RecordingError(
            f"{curve.name}: only {last - first + 1} samples lead to the peak of force or depth, {FEWEST_SAMPLES} or more are needed; "
            "record the way down, or check the force's sign, the columns and the direction of the height"
        )
    return first, last


def _way_down(curve: Curve, begin: int) -> tuple[int, int]:
    """First and last sample of the way to the largest force from a sample on, or to the deepest point before it in the same press."""
    height_m, force_N = curve.height_m[begin:], curve.force_N[begin:]
    turned_m = TURNED * np.ptp(curve.height_m)
    last, deepest = int(np.argmax(force_N)), int(np.argmin(height_m))
    if deepest < last and height_m[deepest : last + 1].max() - height_m[last] <= turned_m:
        last = deepest
    backwards = height_m[last::-1]
    fallen = np.maximum.accumulate(backwards) - backwards
    before = np.flatnonzero(fallen > turned_m)
    first = last - int(np.argmax(backwards[: before[0]])) if len(before) else 0
    return begin + first, begin + last


def _refuse_several_places(curve: Curve, tip_radius_m: float) -> None:
    """Refuse a curve whose larger half of the force was pressed at places that lie more than a tip radius apart."""
    if curve.place_m is None:
        return
    pressed = curve.force_N > 0.5 * (curve.force_N.min() + curve.force_N.max())
    apart_m = math.hypot(*np.ptp(curve.place_m[pressed], axis=0))
    if apart_m > tip_radius_m:
        raise RecordingError(
            f"{curve.name}: the tip presses at places up to {apart_m * 1e3:.3g} mm apart ({', '.join(PLACE)}), expected one place within "
            f"the tip radius of {tip_radius_m * 1e3:.3g} mm; give the rows of one place alone"
        )


def _lines(path: Path) -> list[str]:
    with opened(path, error=RecordingError) as stream:
        content = stream.read()
    if b"\0" in content:
        raise RecordingError(f"{path.name} is not text; export the curve as CSV")
    try:
        return content.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        return content.decode("latin-1").splitlines()  # µ and ° in a header of an older instrument


def _column_names(path: Path, lines: list[str], mapping: Mapping) -> tuple[str, str, str | None]:
    """Names of the columns for force, length and time."""
    if mapping.depth_column is not None and mapping.height_column is not None:
        raise BadInput("--depth-column and --height-column were both given; give the one that the curve is to be judged by")
    if mapping.depth_column is not None and mapping.height_down_positive:
        raise BadInput("--height-down-positive belongs to --height-column; a depth always grows inwards")
    length = mapping.depth_column or mapping.height_column
    if (mapping.force_column, length, mapping.time_column) in ((None, None, None), (*OWN[:2], None)):
        header = next((line for line in lines if not is_comment(line)), "")
        if any(set(OWN) <= set(cells_of(header, delimiter)) for delimiter in DELIMITERS):
            return OWN
    if mapping.force_column is None or length is None:
        missing = "--force-column" if mapping.force_column is None else "--depth-column or --height-column"
        raise BadInput(f"{missing} is missing: {path.name} is no recording of palpd, so name its columns ({_seen(lines)})")
    return mapping.force_column, length, mapping.time_column


def _header(path: Path, lines: list[str], names: list[str]) -> tuple[int, str | None]:
    """The line that names all these columns, and its delimiter; None: white space."""
    for delimiter in (*DELIMITERS, None):
        for at, line in enumerate(lines):
            cells = cells_of(line, delimiter)
            if all(name in cells for name in names):
                twice = [name for name in names if cells.count(name) > 1]
                if twice:
                    raise RecordingError(f"{path.name}: column {twice[0]} stands twice in row {at + 1} (the header); rename one of them")
                return at, delimiter
    absent = [name for name in names if not any(name in line for line in lines)]
    raise RecordingError(
        f"{path.name}: no row names the column{'s' if len(names) > 1 else ''} {', '.join(absent or names)} ({_seen(lines)}); "
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


def _numbers(path: Path, lines: list[str], header: int, delimiter: str | None, columns: dict[str, int]) -> _Table:
    """Rows below the header with a number in every wanted column. Others may stand before and after them, not between."""
    table = _Table(skipped=sum(1 for line in lines[:header] if line.strip()))
    gap: tuple[int, str, str] | None = None
    for number, line in enumerate(lines[header + 1 :], start=header + 2):
        if is_comment(line):
            table.skipped += bool(line.strip())
            continue
        cells = cells_of(line, delimiter)
        if delimiter != ",":
            cells = [cell.replace(",", ".") for cell in cells]
        texts = {name: cells[at] if at < len(cells) else "" for name, at in columns.items()}
        wrong = next((name for name, text in texts.items() if not _is_number(text)), None)
        if wrong is not None:
            table.skipped += 1
            if table.values and gap is None:
                gap = (number, wrong, texts[wrong])
            continue
        if gap is not None:
            row, name, text = gap
            raise RecordingError(
                f"{path.name}: {name} {f'is {text[:40]!r}' if text else 'is empty'} in row {row}, between rows of numbers; "
                "every value must be a finite number, so correct or remove that row"
            )
        if not table.values:
            refuse_decimal_commas(path.name, cells_of(lines[header], delimiter), cells, delimiter)
        table.values.append([float(text) for text in texts.values()])
    return table


def _is_number(text: str) -> bool:
    try:
        return abs(float(text)) <= LARGEST
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
