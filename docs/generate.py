"""Writes docs/reference from the code: commands, files, effects, columns and the Python API.

    python docs/generate.py

The pages are part of the repository, so that links work where nobody has built the site. A test fails where a page differs from what
the code says.
"""

import ast
import inspect
import re
import textwrap
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

import numpy as np
from pydantic import BaseModel
from pydantic_core import PydanticUndefined
from typer.models import ArgumentInfo, OptionInfo

import palpd.api
from palpd.cell.cell_file import CellFile, nominal
from palpd.cell.effects import EFFECTS, Effect, Values
from palpd.cli import application
from palpd.cli.command_groups import GROUPS
from palpd.cli.output_options import examples_of
from palpd.config import Config, Plan
from palpd.daemon.robot_stops import ROBOT_STOPS
from palpd.files import file_use
from palpd.gap.assumptions import ASSUMED
from palpd.gap.similar_effects import Similarity, similar_effects, standard_motion
from palpd.recording.samples import COLUMNS, Samples
from palpd.tick import Floats

FOLDER = Path(__file__).parent / "reference"
HEAD = "<!-- written by docs/generate.py: change the code, not this page -->\n"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table; bars in cells are escaped."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in line) + " |" for line in lines) + "\n"


def prose(text: str | None) -> str:
    """A docstring as Markdown: paragraphs stay, broken lines are joined."""
    return "\n\n".join(" ".join(part.split()) for part in inspect.cleandoc(text or "").split("\n\n"))


# stops of the robot


def robot_stops_page() -> str:
    """What the controller says after a stop, and the steps at its pendant."""
    out = [HEAD, "# Stops of the robot\n"]
    out.append(
        "What the controller says where palpd may not move the arm. Page, `palpd recover-robot` and refusals use these words. "
        "The first row that holds is shown. While it stands, arm, start, retract, level test and clear are refused. "
        "[Back after a stop of the robot](../how-to/after-a-stop.md) leads through them.\n"
    )
    rows = [(f"`{name}`", stop.word, stop.says, stop.step, stop.done) for name, stop in ROBOT_STOPS.items()]
    out.append(table(("`now.stop.name`", "in short", "it says", "at the pendant", "done when"), rows))
    return "\n".join(out)


# commands


def words_of_type(annotation: Any, info: OptionInfo | ArgumentInfo) -> str:
    """What a value of an option looks like."""
    kinds = [kind for kind in (get_args(annotation) if is_union(annotation) else (annotation,)) if kind is not type(None)]
    kind, repeated = kinds[0], ""
    if get_origin(kind) is list:
        kind, repeated = get_args(kind)[0], " …"
    if get_origin(kind) is Literal:
        return " or ".join(f"`{choice}`" for choice in get_args(kind))
    word = {Path: "path", str: "text", int: "whole number", float: "number", bool: ""}[kind]
    return word + within(info.min, info.max) + repeated


def is_union(annotation: Any) -> bool:
    """Whether an annotation is `X | Y`."""
    return get_origin(annotation) in (types.UnionType, typing.Union)


def within(least: float | None, most: float | None) -> str:
    """A range in words, with a leading comma."""
    if least is None and most is None:
        return ""
    return f", {least:g} to {most:g}" if None not in (least, most) else f", at least {least:g}" if most is None else f", at most {most:g}"


def parameters_of(command: Callable[..., None]) -> Iterator[tuple[str, OptionInfo | ArgumentInfo, Any, Any]]:
    """Name, declaration, type and default of every parameter of a command."""
    for name, parameter in inspect.signature(command, eval_str=True).parameters.items():
        annotation, *more = get_args(parameter.annotation) if get_origin(parameter.annotation) is Annotated else (parameter.annotation,)
        info = next((one for one in more if isinstance(one, OptionInfo | ArgumentInfo)), None)
        default = parameter.default
        if info is None and isinstance(default, OptionInfo | ArgumentInfo):
            info, default = default, default.default
        if info is None:
            raise TypeError(f"{command.__name__}: parameter {name} is neither an option nor an argument of typer")
        yield name, info, annotation, default


def command_section(name: str, registered: Any) -> str:
    """What a command does, its arguments, its options and examples."""
    command = registered.callback
    arguments, options = [], []
    usage = f"palpd {name}"
    for parameter, info, kind, default in parameters_of(command):
        if isinstance(info, ArgumentInfo):
            usage += f" {parameter.upper()}" if default is inspect.Parameter.empty else f" [{parameter.upper()}]"
            arguments.append((f"`{parameter.upper()}`", words_of_type(kind, info), "", info.help or ""))
            continue
        shown = "" if default in (None, False, True, inspect.Parameter.empty) else f"`{default}`"
        required = "required" if default is inspect.Parameter.empty else shown
        names = ", ".join(f"`{each}`" for each in (info.default, *(info.param_decls or ())) if isinstance(each, str))
        options.append((names, words_of_type(kind, info), required, info.help or ""))
    rows = [*arguments, *options]
    shown = table(("", "value", "default", "meaning"), rows) if rows else ""
    examples = "\n".join(examples_of(registered))
    usage += " [OPTIONS]" if options else ""
    return f"### palpd {name}\n\n{prose(command.__doc__)}\n\n```\n{usage}\n```\n\n{shown}\nExamples:\n\n```\n{examples}\n```\n"


def commands() -> str:
    """The page of all commands."""
    registered = {application.name_of(each): each for each in application.app.registered_commands}
    out = [HEAD, "# Commands\n"]
    out.append(
        "`palpd COMMAND --help` shows the same in the terminal. Exit codes: 0 done; 2 bad input or refused, with one sentence on stderr; "
        "3 stopped by the guard or a fault, with the reason; 128 + the number of a signal that came while nothing moved (130 Ctrl-C, 143 "
        "SIGTERM). `palpd --install-completion` completes commands in your shell.\n"
    )
    out.append(
        table(("to", "commands"), [(title, ", ".join(f"[{name}](#palpd-{name})" for name in names)) for title, names in GROUPS.items()])
    )
    for title, names in GROUPS.items():
        out.append(f"## {title}\n")
        out += [command_section(name, registered[name]) for name in names]
    return "\n".join(out)


# configuration


UNITS = {
    "N_s_per_m": "N s/m", "rad_per_s": "rad/s", "N_per_min": "N/min", "m_per_s2": "m/s²", "N_per_m": "N/m", "m_per_s": "m/s",
    "N_per_s": "N/s", "per_Nm": "1/Nm", "per_N": "1/N", "rad": "rad", "Nm": "Nm", "Hz": "Hz", "kg": "kg", "Pa": "Pa",
    "N": "N", "m": "m", "s": "s", "MB": "MB",
}  # fmt: skip
"""Units by the ends of names, the longest first."""


def unit_of(name: str) -> str:
    """The unit that a name ends in; empty for none."""
    return next((unit for end, unit in UNITS.items() if name.endswith(f"_{end}")), "")


def meanings(model: type[BaseModel]) -> dict[str, str]:
    """The sentence below each field of a model."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(model))).body
    assert isinstance(tree, ast.ClassDef)
    out = {}
    for field, below in zip(tree.body, tree.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(below, ast.Expr):
            out[field.target.id] = prose(ast.literal_eval(below.value)).replace("None", "null")
    return out


def allowed(schema: dict[str, Any]) -> str:
    """The values that a key takes, from its JSON schema."""
    if "anyOf" in schema:
        return " or ".join(filter(None, (allowed(each) for each in schema["anyOf"])))
    if "enum" in schema:
        return ", ".join(f"`{value}`" for value in schema["enum"])
    kind = schema.get("type")
    if kind == "null":
        return "null"
    if kind == "array":
        many = schema.get("minItems")
        return f"{many} values" if many is not None and many == schema.get("maxItems") else "a list"
    if kind in ("number", "integer"):
        limits = [(sign, schema[key]) for key, sign in RANGES.items() if key in schema]
        return " and ".join(f"{sign} {value:g}" for sign, value in limits) or ("number" if kind == "number" else "whole number")
    return {"string": "text"}.get(str(kind), "a block")


RANGES = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}


def shown_default(value: Any, required: bool) -> str:
    """The default of a key as YAML would have it."""
    if isinstance(value, BaseModel):
        return "as below"
    if required or value is PydanticUndefined or (isinstance(value, (tuple, list)) and not value):
        return ""
    if isinstance(value, (tuple, list)):
        return (
            "`["
            + ", ".join("…" if isinstance(each, BaseModel) else each if isinstance(each, str) else f"{each:g}" for each in value)
            + "]`"
        )
    return "`null`" if value is None else f"`{value:g}`" if isinstance(value, float) else f"`{value}`"


def block_section(title: str, model: type[BaseModel], level: str = "##", beside: Sequence[str] = ()) -> str:
    """A table of the keys of a block; `beside` names keys that need no row."""
    schema, meaning = model.model_json_schema()["properties"], meanings(model)
    rows = []
    for name, field in model.model_fields.items():
        if name in beside:
            continue
        default = field.default
        shown = shown_default(default, field.is_required())
        rows.append((f"`{name}`", unit_of(name), shown, allowed(schema[name]), meaning[name]))
    about = prose(model.__doc__).replace("None", "null")
    return f"{level} {title}\n\n{about}\n\n{table(('key', 'unit', 'default', 'allowed', 'meaning'), rows)}"


def config_page() -> str:
    """config.yaml and plan.yaml."""
    out = [HEAD, "# config.yaml and plan.yaml\n"]
    out.append(
        "`palpd init` writes both files, fit for each other and with comments. `palpd check-config config.yaml --plan plan.yaml` judges "
        "them. An unknown key is refused.\n\nThe environment overrides every key of config.yaml: `PALPD_ROBOT__HOST=192.168.1.10 palpd "
        "run`. Relative paths are relative to the file.\n"
    )
    out.append("## config.yaml\n")
    for name, field in Config.model_fields.items():
        model = field.annotation
        if model is CellFile:
            out.append("### cell\n\nThe cell as the simulator knows it: the keys of [cell.yaml](cell-file.md).\n")
        else:
            out += [block_section(name, each, "###") for each in models_in(model)]
    out.append(block_section("plan.yaml", Plan))
    for name in ("sites", "origin", "search", "free"):
        (model,) = models_in(Plan.model_fields[name].annotation)
        out.append(block_section(name, model, "###"))
    return "\n".join(out)


def models_in(annotation: Any) -> list[type[BaseModel]]:
    """The blocks that an annotation allows."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for each in get_args(annotation) for model in models_in(each)]


def cell_page() -> str:
    """cell.yaml."""
    out = [HEAD, "# cell.yaml\n"]
    out.append(
        "The cell as the simulator knows it. [Write a cell file](../cell.md) says how to come by one. `palpd diagnose`, "
        "`palpd simulate` and `palpd emulate` read it; the same keys may stand under `cell:` in config.yaml. Absent keys take the "
        "default, unknown ones are refused.\n"
    )
    out.append(block_section("All blocks", CellFile))
    for name in ("probe", "sensor", "robot", "tissue", "tolerances", "repeatability", "estimated", "sites", "wall"):
        (model,) = models_in(CellFile.model_fields[name].annotation)
        out.append(block_section(name, model))
    out.append("## effects and learned\n")
    out.append(
        "`effects` holds parameters by the id of an effect: `effects: {tissue.viscoelastic: {ratio: 0.3, tau_s: 1.0}}`. "
        "[The library of effects](effects.md) has all ids and parameters. `learned` holds laws from outside the list, as "
        "[a diagnosis writes them](../outside-the-list.md).\n"
    )
    return "\n".join(out)


# effects


SITE_WORDS = {
    "robot": "the robot's motion",
    "tip": "where the tip is",
    "tissue": "what the tissue does",
    "probe": "what else pushes the probe",
    "clock": "when the sensor reports",
    "sensor": "what the sensor makes of a force",
}
SYMBOLS = (
    ("z, v, a", "height of the tip, its speed and acceleration, up positive"),
    ("d", "depth: the surface's height less that of the tip, at least 0"),
    ("f", "force of the contact"),
    ("fx, fy, fz, tx, ty", "reading of the sensor in base axes; pressing gives fz > 0"),
    ("r, E", "radius of the tip, Young's modulus of the tissue"),
    ("t", "time since the first row of the recording"),
    ("stated", "as the cell file says"),
)


def effects_page() -> str:
    """The library of effects."""
    similar: dict[str, list[Similarity]] = {}
    for one in similar_effects(list(EFFECTS.values()), nominal(), EFFECTS):
        similar.setdefault(one.effect, []).append(one)
    out = [HEAD, "# The library of effects\n"]
    out.append(
        f"What a real cell may do that the nominal one does not: {len(EFFECTS)} effects. A diagnosis weighs all of them. A cell file may "
        "name them, and an emulated cell can have them. [Add an effect](../how-to/add-an-effect.md) brings one of yours.\n"
    )
    out.append(table(("effect", "what it does"), [(f"[`{one.id}`](#{slug(one.id)})", one.what) for one in EFFECTS.values()]))
    out.append("## How to read this page\n\nThe names in a formula are those of the parameters, without their units. Besides:\n")
    out.append(table(("symbol", "meaning"), SYMBOLS))
    out.append(
        "Each figure shows the same motion of the nominal cell: a stroke in the air, two presses with holds of 2 s, then two presses in "
        "motion. Orange is the cell as stated, blue the cell with the effect at a typical size. Below is the difference of both.\n\n"
        "*Confused with* compares effects on the standard motion of `palpd effects`: strokes, holds and presses of three depths. The "
        "cosine is that of the angle between both changes, with everything within specification projected out. Above "
        f"{ASSUMED.advice.one_direction:g} the motion cannot distinguish two effects, below {ASSUMED.advice.mostly_alike:g} "
        f"they are not listed. The SNR is the size of the effect from which on both are distinguished at odds of {ASSUMED.advice.odds:g}. "
        "`palpd effects ID --cell cell.yaml` compares on your cell. "
        "[The blind check](../blind.md) counts which effects were in fact taken for each other.\n"
    )
    site = ""
    for effect in EFFECTS.values():
        if effect.site != site:
            site = effect.site
            out.append(f"## {site.capitalize()}: {SITE_WORDS[site]}\n")
        out.append(effect_section(effect, similar.get(effect.id, [])))
    return "\n".join(out)


def slug(name: str) -> str:
    """The anchor of a heading, as GitHub and MkDocs make it."""
    return name.replace(".", "").lower()


def effect_section(effect: Effect, similar: Sequence[Similarity]) -> str:
    """One effect: formula, parameters, figure, and what it is confused with."""
    rows = [
        (
            f"`{one.name}`",
            one.label,
            "–" if one.unit == "1" else one.unit,
            nominal_words(effect, one.name),
            "may be absent" if one.optional else "",
        )
        for one in effect.named_parameters
    ]
    notes = []
    if effect.tolerance:
        notes.append(f"Within `tolerances.{effect.tolerance}` it is no gap.")
    if effect.starts_at_tare:
        notes.append("It counts from the first row of each recording.")
    if effect.motion:
        notes.append("The robot reports it, so it shows in the heights.")
    if effect.scatter:
        notes.append("It changes the scatter of the readings, not their mean, so a separate test finds it.")
    if effect.family:
        notes.append(f"Other {effect.family} would look the same.")
    alike = [one for one in similar if one.cosine > ASSUMED.advice.mostly_alike]
    confused = "Confused with: nothing on the standard motion.\n" if not effect.scatter else ""
    if alike:
        lines = [(f"[`{one.other}`](#{slug(one.other)})", f"{one.cosine:.2f}", f"{one.told_at_snr:.0f}") for one in alike]
        confused = table(("confused with", "cosine", "distinguished from SNR on"), lines)
    parameters = table(("parameter", "meaning", "unit", "no effect at", ""), rows)
    return (
        f"### {effect.id}\n\n{effect.what[0].upper()}{effect.what[1:]}. {' '.join(notes)}\n\n```\n{effect.formula}\n```\n\n{parameters}\n"
        f"![{effect.id} on a standard motion](figures/{effect.id}.svg)\n\n{confused}"
    )


def nominal_words(effect: Effect, name: str) -> str:
    """The value of a parameter at which the effect is not there."""
    value = effect.parameter(name).nominal
    if value is None:
        return "–"
    return "the stated value" if callable(value) else "∞" if value == float("inf") else f"{value:g}"


def figures(folder: Path) -> None:
    """Draw what each effect does to the standard motion."""
    from palpd.analysis.figure_style import save_figure

    folder.mkdir(parents=True, exist_ok=True)
    for effect in EFFECTS.values():
        save_figure(effect_figure(effect), folder / f"{effect.id}.svg")


LABELS = {"z_m": ("z", "mm", 1e3), "tx_Nm": ("tx", "mNm", 1e3), "ty_Nm": ("ty", "mNm", 1e3)}
ROWS_HZ = 100.0


def effect_figure(effect: Effect) -> Any:
    """The channel that an effect changes most, with and without it, and the difference."""
    from palpd.analysis.figure_style import ENRICHED, GREY, NOMINAL, styled_figure

    cell = palpd.api.Cell.nominal()
    motion = shown_motion(cell.file)
    values = typical(effect, cell.file, motion)
    seed = 1 if effect.scatter else None
    drive: dict[str, Any] = {"drive": "commanded", "noise_seed": seed}
    stated = palpd.api.simulate(motion, cell, **drive)
    other = palpd.api.simulate(motion, cell.with_effects({effect.id: values}), **drive)
    noise = {"z_m": 2e-5, "tx_Nm": 0.01, "ty_Nm": 0.01}
    changes = {
        name: float(np.ptp(other[name] - stated[name])) / noise.get(name, 0.1)
        for name in stated
        if name not in ("t_s", "z_cmd_m", "vz_m_per_s")
    }
    channel = "z_m" if effect.motion else "fz_N" if effect.scatter else max(changes, key=lambda name: changes[name])
    label, unit, factor = LABELS.get(channel, (channel[:2], "N", 1.0))
    t_s = stated["t_s"]
    shown = (t_s > 8.0) & (t_s < 11.5) if effect.scatter else np.ones(len(t_s), dtype=bool)
    with styled_figure(7.4, 3.2) as figure:
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(1.7, 1.0))
        above.plot(t_s[shown], factor * stated[channel][shown], color=NOMINAL, linewidth=2.6, label="as stated")
        above.plot(
            t_s[shown],
            factor * other[channel][shown],
            color=ENRICHED,
            linewidth=1.1,
            label=", ".join(f"{name} {value:.3g}" for name, value in values.items()),
        )
        above.legend(loc="upper left", bbox_to_anchor=(0.0, 1.22), ncols=2)
        below.plot(t_s[shown], factor * (other[channel] - stated[channel])[shown], color=GREY)
        above.set_ylabel(f"{label}, {unit}")
        below.set(xlabel="time, s", ylabel=f"difference, {unit}")
    return figure


def shown_motion(cell: CellFile) -> dict[str, Floats]:
    """The standard motion of a comparison of effects, shortened so that a figure can show it."""
    motion, limits = standard_motion(cell)
    short = replace(motion, depths_m=(0.5 * limits.depth_m, limits.depth_m), hold_s=1.0, repeats=1, strokes=1)
    t_s, z_cmd_m = short.heights(1.0 / ROWS_HZ, 0.0, limits.home_m, limits.acceleration_m_per_s2)
    return {"t_s": t_s, "z_cmd_m": z_cmd_m}


def typical(effect: Effect, cell: CellFile, motion: dict[str, Floats]) -> Values:
    """Parameters of a typical size on a motion; those that may be absent are."""
    from palpd.gap.model.problem import make_problem

    columns = {"z_m": motion["z_cmd_m"], "vz_m_per_s": np.gradient(motion["z_cmd_m"], motion["t_s"])}
    simulated = palpd.api.simulate(motion, cell, drive="commanded", noise_seed=1).samples
    samples = Samples(motion["t_s"], motion["z_cmd_m"], columns["z_m"], columns["vz_m_per_s"], simulated.wrench)
    scale = make_problem([samples], cell, EFFECTS, 2500).scale
    which = -1 if effect.scatter else 0
    return {one.name: one.starts(scale)[which] for one in effect.named_parameters if not one.optional}


# columns


MEANINGS = {
    "t_s": "time, rising from row to row",
    "z_cmd_m": "commanded height of the tip: the controller's target. May be absent; the motion of the robot is then not judged",
    "z_m": "height of the tip as the robot reports it, along the base's z axis, up positive",
    "vz_m_per_s": "vertical speed as the robot reports it. Accelerations are taken from it",
    "fx_N": "force on the probe along the base's x axis",
    "fy_N": "force along y",
    "fz_N": "force along z: pressing gives a positive one",
    "tx_Nm": "torque about the base's x axis, at the sensor",
    "ty_Nm": "torque about y",
    "tz_Nm": "torque about z",
}
TOPICS = {
    "/tcp_pose": "pose of the tip in base axes, as reported",
    "/tcp_twist": "speed of the tip, as reported",
    "/target_pose": "the controller's target",
    "/wrench_raw": "wrench of each sensor sample as the sensor sent it, untared, in the sensor's axes",
    "/wrench": "wrench of each sensor sample, tared, in base axes",
    "/tick": "each tick of the loop, bit for bit: all inputs of a decision, and the decision",
    "/wrench_injected": "only of `palpd inject`: the wrench tared, in base axes, with the planted effect",
}


def recordings_page() -> str:
    """Columns of a table, and topics of a recording of the daemon."""
    from palpd.recording import topics

    kinds: dict[str, str] = topics.TOPICS | {topics.SECOND_TOPIC: topics.SECOND_TYPE}
    if set(MEANINGS) != set(COLUMNS) or set(TOPICS) != set(kinds):
        raise ValueError("a column or a topic has no meaning on the page; add it in docs/generate.py")
    out = [HEAD, "# Recordings\n", "## Columns of a table (CSV, Parquet)\n"]
    out.append(
        "One row is one sample of the sensor, in SI units. `palpd export` and `palpd import` write such tables, and every command reads "
        "them. The wrench is what the environment does to the probe, along the base's axes, tared with the probe free and still.\n"
    )
    out.append(table(("column", "unit", "meaning"), [(f"`{name}`", unit_of(name), MEANINGS[name]) for name in COLUMNS]))
    out.append(
        "Extra columns are ignored. A missing column, a value that is not finite, time that runs backwards, or fewer than 30 rows are "
        "refused with the row and the column. An export of several sites has a column `site` too; `palpd export RUN --csv F --site A` "
        "takes one.\n"
    )
    out.append("## Topics of a recording of the daemon (MCAP)\n")
    out.append(
        "Any tool for ROS 2 and MCAP opens the file. Stamps are Unix time. `palpd recover` restores a file that a crash left behind.\n"
    )
    out.append(table(("topic", "message", "holds"), [(f"`{name}`", f"`{kinds[name]}`", TOPICS[name]) for name in kinds]))
    return "\n".join(out)


# the Python API


def python_page() -> str:
    """The names of `import palpd`."""
    out = [HEAD, "# Python API\n", prose(palpd.api.__doc__).partition("import palpd")[0].strip() + "\n"]
    out.append("[palpd in Python](../api.md) has an example. Errors are `palpd.errors.PalpdError`: one sentence each.\n")
    everything = {name: getattr(palpd.api, name) for name in palpd.api.__all__ if name != "Effect"}
    functions = {name: one for name, one in everything.items() if inspect.isfunction(one)}
    out.append("## Functions\n")
    out += [member_section(name, one, "###") for name, one in functions.items()]
    out.append("## Classes\n")
    for name, one in everything.items():
        if name not in functions:
            out.append(f"### {name}\n\n{docstring(one)}\n")
            out += [member_section(f"{name}.{inner}", each, "####") for inner, each in members(one)]
    out.append(f"### Effect\n\n{docstring(palpd.api.Effect)}\n\n[Add an effect](../how-to/add-an-effect.md) shows one.\n")
    return "\n".join(out)


def members(one: type) -> Iterator[tuple[str, Any]]:
    """Public methods and properties, as the class and its parents define them."""
    seen = set()
    for parent in one.__mro__:
        for name, each in vars(parent).items():
            if parent.__module__ == palpd.api.__name__ and not name.startswith("_") and name not in seen:
                inner = each.__func__ if isinstance(each, classmethod | staticmethod) else each
                if inspect.isfunction(inner) or isinstance(inner, property):
                    seen.add(name)
                    yield name, inner


def member_section(name: str, one: Any, level: str) -> str:
    """Signature and docstring of a function, method or property."""
    if isinstance(one, property):
        return f"{level} {name}\n\n{docstring(one)}\n"
    node = ast.parse(textwrap.dedent(inspect.getsource(one))).body[0]
    assert isinstance(node, ast.FunctionDef)
    node.args.args = [each for each in node.args.args if each.arg not in ("self", "cls")]
    returned = f" -> {ast.unparse(node.returns)}" if node.returns else ""
    return f"{level} {name}\n\n```\n{name.split('.')[-1]}({ast.unparse(node.args)}){returned}\n```\n\n{docstring(one)}\n"


def docstring(one: Any) -> str:
    """A Google docstring as Markdown: its sections become lists."""
    text = inspect.getdoc(one) or ""
    first, *sections = re.split(r"^(Attributes|Args|Returns|Raises):\n", text, flags=re.MULTILINE)
    out = [prose(first)]
    for title, body in zip(sections[::2], sections[1::2], strict=True):
        entries = re.split(r"\n(?=\S)", textwrap.dedent(body).strip())
        items = [re.sub(r"^(\w+): ", r"`\1`: ", " ".join(each.split())) for each in entries]
        shown = "\n".join(f"- {each}" for each in items) if title != "Returns" else " ".join(items)
        out.append(f"**{ {'Args': 'Arguments'}.get(title, title) }**\n\n{shown}" if title != "Returns" else f"**Returns** {shown}")
    return "\n\n".join(out)


PAGES: dict[str, Callable[[], str]] = {
    "commands.md": commands,
    "robot-stops.md": robot_stops_page,
    "config.md": config_page,
    "cell-file.md": cell_page,
    "effects.md": effects_page,
    "recordings.md": recordings_page,
    "python.md": python_page,
}
"""The pages of docs/reference, each with what makes its text."""


if __name__ == "__main__":
    for file, text in PAGES.items():
        (FOLDER / file).parent.mkdir(exist_ok=True)
        (FOLDER / file).write_text(text().rstrip() + "\n", encoding="utf-8")
    with file_use(force=True):
        figures(FOLDER / "figures")
