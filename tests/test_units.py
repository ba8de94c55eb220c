"""Every stored physical quantity carries its unit: fields of the files, of public dataclasses, and options of the command line."""

import dataclasses
import importlib
import pkgutil
import re
import typing
from collections.abc import Iterator

import pytest
import typer
from pydantic import BaseModel

import hw
import palpd
from palpd.cli import app

UNITS = (
    "N", "Nm", "m", "s", "h", "ms", "us", "ns", "Hz", "kg", "Pa", "rad", "MB", "C", "W", "ppm", "percent",
    "m_per_s", "m_per_s2", "rad_per_s", "rad_per_s2", "N_per_m", "N_s_per_m", "N_per_s", "N_per_min", "N_per_m15", "m_per_N", "Nm_per_rad",
    "m2", "N_per_V", "m_per_V", "per_s", "per_min", "MB_per_min", "s_per_s", "kg_m2",
)  # fmt: skip
SUFFIX = re.compile(r"(^|_)(" + "|".join(sorted(UNITS, key=len, reverse=True)) + r")$")

DIMENSIONLESS = {
    "bits": "information",
    "clock_skew": "ratio of two clocks, less one",
    "closed": "share of a gap",
    "contrast": "ratio of two moduli",
    "cosine": "cosine of an angle between two changes",
    "crosstalk": "ratio of forces",
    "damping_ratio": "ratio",
    "power_none": "exponent of the odds of no gap",
    "doubt": "share of the prior that is mixed in",
    "energy": "share of a gap's energy",
    "events_share": "share of a gap's energy",
    "excess": "in units of the noise",
    "expected_gain": "information, in nats",
    "factor": "ratio",
    "register_scale": "ratio",
    "filter_cutoff": "relative tolerance",
    "forever": "probability",
    "fx_per_fz": "ratio of forces",
    "fy_per_fz": "ratio of forces",
    "gain": "ratio",
    "gained": "log probability",
    "largest_gain": "squares of sigmas",
    "leading_leaves": "share of a misfit",
    "log_bayes_factor": "log probability",
    "log_determinant": "log of a ratio of volumes",
    "log_exact": "log probability",
    "log_likelihood": "log probability",
    "log_prior": "log probability",
    "misfit": "chi squared",
    "most": "information, in nats",
    "n_effective": "number",
    "nats": "log probability",
    "natural": "in the unit of its parameter",
    "noise_ratio": "ratio",
    "occam": "log probability",
    "p": "probability",
    "p_none": "probability",
    "p_outside": "probability",
    "p_unknown": "probability",
    "participation": "share of the mass",
    "poisson_ratio": "ratio",
    "power": "exponent of odds",
    "price": "log probability",
    "probability": "probability",
    "reached_snr": "signal-to-noise ratio",
    "scatter_stiffness": "relative standard deviation",
    "servo_damping": "damping ratio",
    "servo_damping_ratio": "ratio",
    "servo_natural_frequency": "relative tolerance",
    "servo_ratio": "ratio of frequencies",
    "pulled_over_pressed": "ratio of two slopes",
    "settled": "share",
    "price_share": "share of a price",
    "share": "probability",
    "share_known": "probability",
    "sign": "plus or minus one",
    "skew": "ratio of two clocks, less one",
    "snr": "signal-to-noise ratio",
    "sought_snr": "signal-to-noise ratio",
    "stiffness": "relative standard deviation",
    "strongest": "strength, a multiple of the drawn shape",
    "told_at_snr": "signal-to-noise ratio",
    "youngs_modulus": "relative tolerance",
    "lasting": "factor on an rms",
    "least_share": "share of a tolerance",
    "noise": "relative tolerance",
    "wander_nats": "log probability",
}
"""Names of quantities without a unit, and why they have none."""

ANY_UNIT = {
    "Basis": "a driver of any unit, which it names",
    "Driver": "a quantity of any unit, which it names",
    "Formula": "a driver of any unit, which it names",
    "FormulaShape": "a driver of any unit, which its formula names",
    "PlausibleRange": "a range of any unit, which stands beside",
    "OpenParameter": "a parameter or deviation of any unit, which its name says",
    "OwnParameter": "a parameter of a user's own simulator, in a unit of its own",
    "Coordinate": "a parameter of any effect, in the unit of its name",
    "DetectionLimit": "a parameter of an effect, which stands beside",
    "DetectableSize": "a parameter of any effect, which stands beside",
    "PhaseGap": "a channel of any unit, which stands beside",
    "Shrink": "a channel of any unit, which stands beside",
    "MotionCheck": "a channel of any unit, which stands beside",
    "GuardState": "of whatever tripped, which stands beside with its unit",
    "Step": "a motion of lengths and angles at once, in m and rad",
    "Ramp": "a speed of the tip in m and rad at once, as URScript has it",
    "TrapezoidalMove": "a way in m or rad, whichever leads, as URScript has it",
    "Verdict": "of whatever tripped, which stands beside with its unit",
    "Value": "a published figure, whose unit stands beside",
    "Score": "a line of a table; `share` tells the unit",
    "Fit": "a fit to gaps of any unit, in units of the noise",
    "ChartPoint": "a figure of a day, which it names",
    "EffectPoint": "a parameter of any effect, which it names",
    "Slope": "of a modulus or of a parameter of any effect, which stands beside, over days",
    "CommentedValue": "a value of a cell file, whose key stands beside",
    "Explanation": "a statistic of published figures",
    "Averages": "a published figure, whose unit stands in the table's head",
}
"""Classes whose numbers have a unit that is data, and where it stands."""


def public_classes() -> Iterator[type]:
    """Pydantic models, dataclasses and named tuples of palpd and hw."""
    for package in (palpd, hw):
        for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if info.name.endswith("__main__"):
                continue
            for name, item in vars(importlib.import_module(info.name)).items():
                if isinstance(item, type) and item.__module__ == info.name and not name.startswith("_"):
                    yield item


def float_fields(item: type) -> list[str]:
    """Public fields that hold one float and do not state a unit of their own, as those of `palpd.gap.assumptions` do."""
    if not (issubclass(item, BaseModel) or dataclasses.is_dataclass(item) or hasattr(item, "_fields")):
        return []
    hints = typing.get_type_hints(item)
    stated = {field.name for field in dataclasses.fields(item) if "unit" in field.metadata} if dataclasses.is_dataclass(item) else set()
    return [name for name, hint in hints.items() if hint in (float, float | None) and not name.startswith("_") and name not in stated]


def float_options() -> Iterator[tuple[str, str]]:
    """(command, parameter) of every option and argument of the command line that takes a float."""

    def walk(group: typer.Typer) -> Iterator[tuple[str, str]]:
        for nested in group.registered_groups:
            if nested.typer_instance is not None:
                yield from walk(nested.typer_instance)
        for command in group.registered_commands:
            assert command.callback is not None
            for name, hint in typing.get_type_hints(command.callback).items():
                if hint in (float, float | None) or typing.get_args(hint)[:1] == (float,):
                    yield command.callback.__name__, name

    return walk(app)


def has_unit(name: str) -> bool:
    """Whether a name ends with a unit, or stands for a quantity that has none."""
    return bool(SUFFIX.search(name)) or name in DIMENSIONLESS


def test_every_float_field_has_a_unit_or_a_reason() -> None:
    bare = [
        f"{item.__module__}.{item.__name__}.{name}"
        for item in public_classes()
        if item.__name__ not in ANY_UNIT
        for name in float_fields(item)
        if not has_unit(name)
    ]
    assert not bare, "\n".join(bare)


def test_every_float_option_has_a_unit_or_a_reason() -> None:
    options = list(float_options())
    assert options, "no option takes a float; the check reads the command line in a wrong way"
    bare = [f"{command}: {name}" for command, name in options if not has_unit(name)]
    assert not bare, "\n".join(bare)


def test_no_exception_is_left_over() -> None:
    classes = list(public_classes())
    fields = {name for item in classes for name in float_fields(item)} | {name for _, name in float_options()}
    assert not sorted(DIMENSIONLESS.keys() - fields)
    assert not sorted(ANY_UNIT.keys() - {item.__name__ for item in classes})


@pytest.mark.parametrize(
    ("name", "has"), [("force_N", True), ("speed_m_per_s", True), ("m", True), ("force", False), ("depth_mm", False), ("gain", True)]
)
def test_the_check_knows_a_unit_from_a_word(name: str, has: bool) -> None:
    assert has_unit(name) is has
