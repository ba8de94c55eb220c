"""The README of an exported folder: what is where, how to run it, and what is in the engine and what in palpd's code."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

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
    return (_mujoco if target == "mujoco" else _fmu)(cell, numbers, draws, agreement)


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ("---",) * len(head), *rows))


def _drawn(draws: int, use: str) -> str:
    if not draws:
        return ""
    return f"""
## {draws} drawn cells

They are drawn from what the diagnosis left open: its hypotheses by their probability, and for each the parameters and the deviations
within tolerance with their correlations. `draws/draw-001.yaml` and so on are cell files of palpd. `cells.json` holds their numbers after
those of the exported cell, so one model serves all of them.
{use}
"""


def _agreed(agreement: Agreement) -> str:
    rows = [(f"`{name}`", f"{off:.1e}") for name, off in agreement.off.items()]
    return f"""
## How well it agrees with palpd

Rms difference on `motion.csv` to `palpd simulate`, in rms of the stated noise of the channel, measured when this folder was written.
An export that is off by more than 0.2 in any channel is refused, so nothing of the cell is missing here.

{_table(("channel", "difference / noise"), rows)}

palpd simulates the same motion with `palpd simulate motion.csv --cell cell.yaml --csv expected.csv`.
"""


def _effects(cell: CellFile, place: Mapping[str, str], otherwise: str) -> str:
    names = [*cell.effects, *(one.id for one in cell.learned)]
    rows = [(f"`{name}`", place.get(name, otherwise)) for name in names]
    return _table(("effect of this cell", "where it is"), rows) if rows else "The exported cell has no effects."


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


def _mujoco(cell: CellFile, numbers: Mapping[str, Any], draws: int, agreement: Agreement) -> str:
    files = [
        ("`cell.xml`", "the model: a probe on a vertical slide, its servo, the force sensor, tissue to look at"),
        ("`palpd_cell.py`", "the callback, with the laws of this cell; also the command that rolls a motion out"),
        ("`cells.json`", "the numbers of the cell, after in-tolerance deviations, and of the drawn cells"),
        ("`motion.csv`", "an example motion: two presses"),
        ("`cell.yaml`", "the cell file of palpd that was exported"),
    ]
    height_m = float(numbers["start_z_m"]) - 0.006
    native = [
        ("servo of the robot", "engine: `position` actuator, RK4; the armature is so large that no contact moves the tip"),
        ("mass and inertia of the probe", "engine: body `probe`, felt by the sensor `force_on_sensor`"),
        ("contact (Hertz), on the body", "callback: `xfrc_applied`, since the engine's contacts follow another law"),
        ("low-pass, gain, crosstalk, zero", "callback: the sensors `fx_N` to `tz_Nm`"),
        ("in-tolerance deviations (`estimated` in `cell.yaml`)", "in the numbers of `cells.json`, which set all of the above"),
    ]
    return f"""# A cell of palpd in MuJoCo

This folder needs Python with `mujoco` (3.5 or newer) and `numpy`{" and `pydantic`" if cell.learned else ""}. It does not need palpd.

{_table(("file", "what it is"), files)}

## Run it

```bash
python palpd_cell.py motion.csv --csv rollout.csv
python palpd_cell.py motion.csv --csv noisy.csv --noise 1
```

A motion is a CSV with the columns `t_s` and `z_cmd_m`: the commanded height of the tip in m, up positive, straight between its rows. The
CSV that is written has the columns of a recording of palpd. In your own code:

```python
import mujoco
from palpd_cell import start

model = mujoco.MjModel.from_xml_path("cell.xml")
data = mujoco.MjData(model)
start(model, data)                       # resets data: the probe at rest above the tissue
for _ in range(1000):
    data.ctrl[0] = {height_m:.4f}              # commanded height of the tip in m
    mujoco.mj_step(model, data)
print(data.sensor("fz_N").data[0])       # what the force sensor reads in N
```

- After `mj_resetData` a new recording begins: histories of the cell are empty. Call `start` again for another draw.
- `start` takes MuJoCo's one sensor callback of the process (`mujoco.set_mjcb_sensor`), so processes run in parallel, and threads do not.
- There is no gravity: the readings of palpd are tared. The callback overwrites `xfrc_applied` of the body `probe`.
- To put the probe on your own arm, move the body `probe` with its sites and sensors there, and keep the joint and actuator names, or
  change them in `CellInMujoco`. A cell keeps its tip where the servo puts it; an arm that gives way is another cell.
{_drawn(draws, f"`python palpd_cell.py motion.csv --csv last.csv --draw {draws}` and `start(model, data, draw={draws})` take the last.")}
## What is where

{_table(("part of the cell", "where it is"), native)}

{_effects(cell, _native_of(numbers), "callback")}
{_agreed(agreement)}"""


def _fmu(cell: CellFile, numbers: Mapping[str, Any], draws: int, agreement: Agreement) -> str:
    files = [
        ("`PalpdCell.fmu`", "FMI 3.0 for co-simulation, Linux and Windows on x86-64"),
        ("`rollout.py`", "rolls a motion out with fmpy"),
        ("`cells.json`", "the numbers of the cell, after in-tolerance deviations, and of the drawn cells; the FMU holds a copy"),
        ("`motion.csv`", "an example motion: two presses"),
        ("`cell.yaml`", "the cell file of palpd that was exported"),
    ]
    variables = [
        ("`z_cmd_m`", "input", "commanded height of the tip in m, up positive"),
        ("`z_m`, `vz_m_per_s`", "output", "height and speed that the robot reports"),
        ("`fx_N`, `fy_N`, `fz_N`, `tx_Nm`, `ty_Nm`, `tz_Nm`", "output", "what the force sensor reads; pressing gives `fz_N` > 0"),
        ("`draw`", "parameter", "0: the exported cell, k: the k-th drawn one"),
        ("`noise_seed`", "parameter", "seed of noise and rounding; -1: none"),
    ]
    needs = "`numpy` and `pydantic`" if cell.learned else "`numpy`"
    return f"""# A cell of palpd as an FMU

The FMU is Python inside (pythonfmu3). Where it runs there must be Python 3.10 or newer with {needs}. It does not need palpd.

| the master is | what it needs |
| --- | --- |
| a Python program, such as `rollout.py` with fmpy | nothing more: the FMU uses the Python that runs it |
| another program on Linux | `LD_PRELOAD=/path/to/libpython3.11.so` (of your Python) before it starts |
| another program on Windows | `python3.dll` on the PATH (not tried) |

{_table(("file", "what it is"), files)}

## Run it

```bash
python rollout.py motion.csv --csv rollout.csv
python rollout.py motion.csv --csv noisy.csv --noise 1
```

A motion is a CSV with the columns `t_s` and `z_cmd_m`: the commanded height of the tip in m, up positive, straight between its rows. The
CSV that is written has the columns of a recording of palpd.

{_table(("variable", "is", "meaning"), variables)}

- The probe rests at the value that `z_cmd_m` has when initialization ends.
- Between two communication points the command is a straight line. Steps of {1e3 * float(numbers["step_s"]):g} ms or shorter agree
  best; a longer step is divided inside.
- A sensor that is ahead of the robot (a negative latency) is a robot that reports late. `rollout.py` takes that out of the rows.
{_drawn(draws, f"The parameter `draw` chooses. `python rollout.py motion.csv --csv last.csv --draw {draws}` takes the last.")}
## What is where

Everything is computed by palpd's laws inside the FMU. The file `resources/palpd_cell_….py` in it can be read.

{_effects(cell, dict.fromkeys(("sensor.noise", "sensor.dropout"), "laws, with `noise_seed` only"), "laws")}
{_agreed(agreement)}"""
