"""The README of an exported folder: what is where, how to run it, and what is in the engine and what in palpd's code."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jinja2

from palpd.cell.cell_file import CellFile
from palpd.cell.effects import EFFECTS


class Agreement(NamedTuple):
    """How far a rollout is from palpd's simulation, in rms of the stated noise, by channel; and the channel of the largest."""

    off: Mapping[str, float]
    channel: str

    @property
    def worst(self) -> float:
        """The largest of them; not a number where one is."""
        return self.off[self.channel]


NATIVE = {
    "robot.lag": "gains of the actuator `servo`",
    "probe.mass": "mass of the body `probe`",
    "sensor.latency": "delay of the sensor `force_on_sensor`",
    "sensor.saturation": "`cutoff` of the sensor `fz_N`",
}
"""Effects that an element of MuJoCo is exactly, and the element."""

BEFORE_THE_DELAY = {effect.id for effect in EFFECTS.values() if effect.law is not None and effect.site in ("robot", "probe", "clock")}
"""Effects whose laws act before the sensor's delay."""


TEMPLATES = jinja2.Environment(
    loader=jinja2.PackageLoader("palpd.interchange", "simulators"),
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
    undefined=jinja2.StrictUndefined,
)
"""README and model, beside this file."""


def readme(target: str, cell: CellFile, numbers: Mapping[str, Any], draws: int, agreement: Agreement) -> str:
    """The README of an exported folder.

    Args:
        target: `mujoco` or `fmu`.
        numbers: Its numbers, as `cells.json` holds them.
        draws: Number of drawn cells.
        agreement: How far the rollout is from palpd's simulation.

    Returns:
        The text, in Markdown.
    """
    return TEMPLATES.get_template(f"readme_{target}.md.j2").render(
        effects=[*cell.effects, *(law.id for law in cell.learned)],
        learned=cell.learned,
        native=_native_of(numbers),
        numbers=numbers,
        draws=draws,
        agreement=agreement,
    )


def _native_of(numbers: Mapping[str, Any]) -> dict[str, str]:
    """Where the effects of the cell are that the engine can be, as `palpd_cell.py` decides it."""
    c, out = numbers["constants"], dict(NATIVE)
    before = [name for name in numbers["laws"] if name in BEFORE_THE_DELAY or name.startswith("learned.")]
    if c["skew"] or c["delay_s"] < numbers["step_s"] or before:
        out["sensor.latency"] = "callback, since the engine has no delay below one step, and none behind another effect"
    if c["step_N"]:
        out["sensor.saturation"] = "callback, since the coarse step comes after it"
    out["robot.vibration"] = "callback; the probe moves in the readings, and not on the screen"
    for name in ("sensor.noise", "sensor.dropout"):
        out[name] = "callback, with `--noise SEED` only (the engine's attribute `noise` adds nothing)"
    return out
