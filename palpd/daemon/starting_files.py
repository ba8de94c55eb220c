"""`palpd init`: a config.yaml and a plan.yaml that fit each other, made from those that come with palpd."""

import math
import re
from collections.abc import Sequence
from pathlib import Path

from palpd.cell.plausible import ask, doubts, doubts_of_cell
from palpd.config import Config, Plan, load_config, load_plan, parse_config, parse_plan
from palpd.control.inertial import InertialModel
from palpd.control.sequence import SOFT_END
from palpd.daemon.overshoot import refuse_together
from palpd.daemon.wiring import robot_kind, sensor_kind
from palpd.documents import parse_yaml
from palpd.errors import BadInput, ConfigError
from palpd.file_kinds import YAML
from palpd.files import check_folder, check_writable, shipped, write_yaml

HARDEST_PA = 143_200.0
"""Modulus that depths and limit are fitted to: the hardest site of the paper's phantom."""
STEP_M = 0.0005
"""Depths are rounded down to this: a plan reads better, and the surface is known to 0.1 mm."""
ABSOLUTE_PER_CONTACT = 2.0
"""Absolute limit over contact limit, as shipped: 25 N over 12 N."""


def checked(config_file: Path, plan_file: Path | None, accept_implausible: bool = False) -> tuple[Config, Plan]:
    """Read a configuration and a plan, and refuse what is wrong or unsafe, as `palpd check-config` does.

    Args:
        config_file: config.yaml.
        plan_file: plan.yaml; without one the built-in plan is judged.
        accept_implausible: Whether implausible values count.

    Returns:
        Both.

    Raises:
        ConfigError: One of them is wrong, or they are unsafe together.
        BadInput: A driver, the model or a folder cannot be used, or a value is implausible and nobody accepts it.
    """
    config = load_config(config_file)
    plan = load_plan(plan_file) if plan_file else Plan()
    refuse_together(config, plan)
    sensor_kind(config)
    robot_kind(config)
    check_folder(config.paths.runs, config.paths.state)
    if config.model.path is not None:
        InertialModel.load(config.model.path, probe_mass_kg=config.cell.probe.mass_kg)
    heights = config.safety.workspace_m[2] if config.safety.workspace_m else ()
    odd = [doubt for height_m in heights for doubt in doubts("height", height_m, "a height of safety")]
    ask([*odd, *doubts_of_cell(config.cell)], accept_implausible, f"correct {config_file.name}")
    return config, plan


def write_starting_files(folder: Path, model: str, limit_N: float, depths_m: Sequence[float]) -> tuple[Path, Path]:
    """Write config.yaml and plan.yaml into a folder.

    Args:
        folder: Folder to write to; made where it is missing.
        model: ur5 or ur5e.
        limit_N: Contact limit.
        depths_m: Depths of the plan; empty: the deepest that the limit allows on 143 kPa, 5/6 and 4/6 of it.

    Returns:
        Paths of both files.

    Raises:
        BadInput: A file exists, or the folder cannot be made or written into.
        ConfigError: The limit, or the depths with it, are refused; nothing is written then.
        Refused: The files to start from did not come with the code.
    """
    files = folder / "config.yaml", folder / "plan.yaml"
    check_folder(folder)
    if folder.is_dir():
        check_writable(*files, kind=YAML)
    tip_radius_m = Config().cell.probe.tip_radius_m
    deepest_m = STEP_M * math.floor((SOFT_END**2 * limit_N / (_stiffness(tip_radius_m))) ** (2 / 3) / STEP_M)
    chosen_m = tuple(depths_m) or tuple(STEP_M * math.floor(deepest_m * share / 6 / STEP_M + 1e-9) for share in (4, 5, 6))
    absolute_N = max(25.0, ABSOLUTE_PER_CONTACT * limit_N)
    config_text = _with(
        shipped("config.yaml").read_text(),
        {
            "model: ur5": f"model: {model}",
            "contact_limit_N: 12": f"contact_limit_N: {limit_N:g}",
            "absolute_limit_N: 25": f"absolute_limit_N: {absolute_N:g}",
        },
    )
    plan_text = re.sub(
        r"^depths_m:.*$",
        f"depths_m: [{', '.join(f'{d:g}' for d in chosen_m)}]   # fit contact_limit_N of {limit_N:g} N on 143 kPa",
        shipped("plan.yaml").read_text(),
        flags=re.MULTILINE,
    )
    config = parse_config(parse_yaml(config_text, str(files[0])).content, str(files[0]))
    plan = parse_plan(parse_yaml(plan_text, str(files[1])).content, str(files[1]))
    refuse_together(config, plan)
    force_N = _stiffness(tip_radius_m) * max(plan.depths_m) ** 1.5
    if force_N > SOFT_END * limit_N:
        raise ConfigError(
            f"{max(plan.depths_m) * 1e3:g} mm into {HARDEST_PA / 1e3:.0f} kPa needs {force_N:.1f} N, above the {SOFT_END * limit_N:.1f} N "
            "at which a press is cut short; choose shallower depths or a higher limit"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as failure:
        raise BadInput(f"{folder} cannot be made ({failure.strerror or failure}); give another folder") from failure
    for file, text in zip(files, (config_text, plan_text), strict=True):
        write_yaml(file, text)
    return files


def _stiffness(tip_radius_m: float) -> float:
    """Factor of d^1.5 in Hertz's law for a sphere on incompressible material: 4/3 E/(1 - 0.5²) sqrt(R)."""
    return 4.0 / 3.0 * HARDEST_PA / 0.75 * math.sqrt(tip_radius_m)


def _with(text: str, changes: dict[str, str]) -> str:
    """The text with each line's key replaced."""
    for old, new in changes.items():
        text = re.sub(rf"^(  ){re.escape(old)}\b", rf"\g<1>{new}", text, count=1, flags=re.MULTILINE)
    return text
