"""Effects planted into recordings: real ones whose own causes are declared, or recordings of healthy cells that MuJoCo simulated.

The planted laws are this check's own and not the library's. What they change is computed on the motion of the recording, with its own
force, and is added to what was measured. So the noise, the motion and every oddity of the host are real.

A folder of hosts holds X.csv and X.yaml, and a file `causes.yaml` (or one that is named) that says for every host what acts in it:

    X: {causes: [cable.friction, robot.backlash]}
    Y: {causes: []}
    Z: {causes: [sensor.saturation], unlisted: true}

A cause of the host is never planted again, and naming it is right. A recording in which something outside the list acts is no host,
since `unknown` would be right whatever is planted.
"""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from palpd.blind.detectability import Detectability, FittedLaw
from palpd.blind.drawn_cases import STRATA, by_place, describe, laws_of, nearest_listed, plant, second_rms, true_change_of
from palpd.blind.drawn_cells import CellRealisation
from palpd.blind.laws import INDISTINGUISHABLE, LIBRARY_LAWS, Floats, Planted, SensorRows
from palpd.blind.recorded_cells import cell_of, detectability_of
from palpd.blind.simulated_run import rows
from palpd.blind.stated_cell import CHANNELS, PHASES, rounded
from palpd.blind.truth import CannotDraw, CaseKind, CaseSpec, NearestLaw, SealedCase, TrueChange, Truth
from palpd.documents import read_yaml
from palpd.errors import BadInput
from palpd.recording.samples import Samples, read_csv

HOSTS_TRIED = 3
"""Number of hosts that are tried for the effects of a case."""


@dataclass(frozen=True)
class Host:
    """A recording to plant effects into: `content` are the keys of its cell file, `causes` the listed effects that act in it.

    `second` is a noise-free recording of the same cell on another motion; None for a real one.
    """

    name: str
    content: dict[str, Any]
    samples: Samples
    causes: tuple[str, ...]
    second: Samples | None = None


@dataclass(frozen=True)
class DeclaredCauses:
    """What acts in a recording: listed effects, and whether something outside the list does."""

    causes: tuple[str, ...]
    unlisted: bool


def load_causes(path: Path) -> dict[str, DeclaredCauses]:
    """Read the causes of recordings.

    Args:
        path: A file as in the docstring of this module.

    Returns:
        The causes by the name of the recording.

    Raises:
        BadInput: An entry is not of that form, or a cause is not listed.
    """
    listed = {law.effect for law in LIBRARY_LAWS}
    declared = {}
    for name, entry in read_yaml(path, error=BadInput).keys_and_values().items():
        given = dict(entry) if isinstance(entry, Mapping) else {}
        causes, unlisted = given.pop("causes", None), given.pop("unlisted", False)
        if given or not isinstance(causes, list) or not isinstance(unlisted, bool):
            raise BadInput(f"{path.name}: {name} is {entry!r}; expected {{causes: [ids of effects], unlisted: true or false}}")
        if strange := [cause for cause in causes if cause not in listed]:
            raise BadInput(f"{path.name}: {name} names {strange[0]!r}, which is not in the list; say `unlisted: true` in its place")
        declared[str(name)] = DeclaredCauses(tuple(causes), unlisted)
    return declared


def declared_recordings(folder: Path, causes: Path | None) -> list[tuple[Path, DeclaredCauses]]:
    """The recordings of a folder whose causes are declared.

    Args:
        folder: It holds X.csv and X.yaml, also in folders inside it.
        causes: The file of causes; None: `causes.yaml` in the folder.

    Returns:
        The recordings with their causes, in the order of the file.

    Raises:
        BadInput: A declared recording is missing.
    """
    recordings = []
    for name, declared in load_causes(causes or folder / "causes.yaml").items():
        paths = [path for path in sorted(folder.rglob(f"{name}.csv")) if path.with_suffix(".yaml").exists()]
        if len(paths) != 1:
            raise BadInput(f"{folder} holds {len(paths)} recordings {name}.csv with {name}.yaml; expected one for each declared name")
        recordings.append((paths[0], declared))
    return recordings


def load_hosts(folder: Path, causes: Path | None) -> list[Host]:
    """The recordings of a folder that effects can be planted into.

    Args:
        folder: It holds X.csv and X.yaml.
        causes: The file of causes; None: `causes.yaml` in the folder.

    Raises:
        BadInput: There is none.
    """
    hosts = [
        Host(path.stem, read_yaml(path.with_suffix(".yaml"), error=BadInput).keys_and_values(), read_csv(path), declared.causes)
        for path, declared in declared_recordings(folder, causes)
        if not declared.unlisted
    ]
    if not hosts:
        raise BadInput(f"no recording in {folder} can be a host; declare at least one without `unlisted: true`")
    return hosts


def simulated_host(seed: int, index: int) -> Host:
    """A healthy cell that MuJoCo simulated within tolerance of its file, with noise and before rounding.

    Args:
        seed: Seed of the check.
    """
    from palpd.blind.mujoco_cells import draw_healthy

    case = draw_healthy(seed, index)
    fine = replace(case.stated, resolution_fxy_N=0.0, resolution_fz_N=0.0, resolution_Nm=0.0)
    return Host(f"mujoco {index}", case.stated.as_yaml(), case.recording(stated=fine), (), case.reading([], other=True).samples)


def coarsened(host: Host, over_noise: tuple[float, float, float]) -> Host:
    """The host with coarse steps in its cell file, to which its recording is rounded once the effects are in it.

    A step is a whole multiple of the recording's own, and that itself where it is coarser: no reading is rounded to another lattice.

    Args:
        over_noise: Steps as in a `CaseSpec`. The noise is that of the cell file; where it states none, that of the recording.

    Returns:
        The host. Its cell file states the steps, and the noise before them if it did so already.
    """
    cell = cell_of(host.content, host.samples)
    keys = ("resolution_fxy_N", "resolution_fz_N", "resolution_Nm")
    columns = (slice(0, 2), slice(2, 3), slice(3, 6))
    coarse = np.array(over_noise) * [cell.noise_rms_N, cell.noise_rms_N, cell.noise_rms_Nm]
    own = [max(map(own_step, host.samples.wrench[:, axes].T)) for axes in columns]
    steps = {key: max(round(x / step), 1) * step if step else float(x) for key, x, step in zip(keys, coarse, own, strict=True)}
    sensor = {**(host.content.get("sensor") or {}), **{key: step for key, step in steps.items() if step}}
    return replace(host, content={**host.content, "sensor": sensor})


def own_step(values: Floats) -> float:
    """Smallest distance between two readings of a channel.

    Args:
        values: Readings (n,).

    Returns:
        The distance in the unit of the channel; 0 where all readings are equal.
    """
    levels = np.unique(np.round(values, 9))
    return float(np.diff(levels).min()) if len(levels) > 1 else 0.0


def draw_injected(spec: CaseSpec, seed: int, hosts: Sequence[Host]) -> SealedCase:
    """Plant the effects of a case into a host. The same arguments give the same case.

    An effect that the host does not show at the wanted SNR is planted at the next lower one, then at the next higher one.

    Args:
        spec: What the case shall be.
        seed: Seed of the check.
        hosts: Hosts to choose from; none: MuJoCo simulates them.

    Raises:
        CannotDraw: No host shows the effects.
    """
    strata = list(STRATA)
    first = strata.index(spec.stratum)
    for attempt in range(HOSTS_TRIED):
        host = hosts[(spec.index + attempt) % len(hosts)] if hosts else simulated_host(seed + 1, HOSTS_TRIED * spec.index + attempt)
        if spec.steps_over_noise:
            host = coarsened(host, spec.steps_over_noise)
        fine = detectability_of(host.content, host.samples)
        taken = {*host.causes, *(other for cause in host.causes for other in INDISTINGUISHABLE.get(cause, ()))}
        if taken & set(spec.effects):
            continue
        for stratum in (*strata[first::-1], *strata[first + 1 :]):
            r = np.random.default_rng([seed, spec.index, attempt, strata.index(stratum)])
            with contextlib.suppress(CannotDraw):
                return _inject(r, replace(spec, stratum=stratum), host, fine)
    raise CannotDraw(f"case {spec.index}: no host shows {', '.join(spec.effects)}")


def _inject(r: np.random.Generator, spec: CaseSpec, host: Host, fine: Detectability) -> SealedCase:
    plants: list[FittedLaw] = []
    for effect in spec.effects:
        kind: CaseKind = "foreign" if spec.kind == "two" else spec.kind
        laws = laws_of(kind, effect)
        plants.append(plant(r, fine, laws[int(r.integers(len(laws)))], STRATA[spec.stratum]))
    planted: list[Planted] = [(one.law, one.parameters) for one in plants]
    changes = [one.change for one in plants if one.change is not None]
    sizes = fine.sizes(np.sum(changes, axis=0)) if changes else np.zeros((len(CHANNELS), len(PHASES)))
    sealed = describe(plants, fine)
    mimic: NearestLaw | None = None
    if changes and spec.kind in {"novel", "foreign"} and not spec.extra:
        only = spec.effects[0] if spec.kind == "foreign" else None
        nearest = nearest_listed(fine, planted, spec.index, only=only)
        if only is None:
            mimic = nearest
        else:
            sealed[0]["nearest"] = nearest
    true_change: TrueChange | None = None
    if spec.kind == "novel":
        sealed[0]["statement"] = plants[0].law.states(plants[0].parameters, fine.cell.surface_z_m)
        true_change = true_change_of(fine.run(planted), fine.motion.at(fine.t_s), fine.t_s, changes[0]) if changes else None
    second, rms = None, None
    if host.second is not None:
        there = detectability_of(host.content, host.second, noise_free=True)
        second = changed(host.second, there, planted, None)
        rms = second_rms(there, there.change(planted) if planted else np.zeros((len(host.second), len(CHANNELS))))
    truth: Truth = {
        "source": "injected",
        "kind": spec.kind,
        "effects": sealed,
        "host_causes": list(host.causes),
        "without": [],
        "size": float(sizes.max()),
        "sizes": by_place(sizes),
        "rate_Hz": host.samples.rate_Hz,
        "robot_rate_Hz": host.samples.rate_Hz,
        "rows": len(host.samples),
        "duration_s": host.samples.duration_s,
        "mimic": mimic,
        "second": rms,
        "about": {"host": host.name, "stratum": spec.stratum},
    }
    samples = changed(host.samples, fine, planted, r)
    samples = replace(samples, wrench=rounded(samples.wrench, fine.cell.steps))
    return SealedCase(host.content, samples, (), second, truth, true_change)


def changed(samples: Samples, detectability: Detectability, planted: Sequence[Planted], random: np.random.Generator | None) -> Samples:
    """A recording with effects planted into it.

    Args:
        samples: The recording, m rows.
        random: Generator of added noise; None adds none.

    Returns:
        The recording with what the laws change. Channels that it does not hold stay as they are.
    """
    t_s, plain = detectability.t_s, detectability.plain
    run = detectability.run(planted)
    change = rows(run, t_s) - detectability.plain_rows
    change[:, [k for k in detectability.cell.silent if k]] = 0.0
    wrench = samples.wrench + change[:, 1:]
    if random is not None and run.noise_ratio > 1.0:
        white = random.standard_t(4.0, wrench.shape) / 2.0**0.5 if run.heavy_tails else random.standard_normal(wrench.shape)
        wrench = wrench + np.sqrt(run.noise_ratio**2 - 1.0) * _added_noise(detectability.cell) * white
    readings = SensorRows(t_s, wrench, random or np.random.default_rng(0))
    for law, shape in planted:
        if law.stage == "row" and not (law.variance and random is None):
            law.apply(readings, shape)
    v = samples.vz_m_per_s + np.interp(t_s, run.t_s, run.vz_m_per_s - plain.vz_m_per_s)
    return Samples(samples.t_s, samples.z_cmd_m, samples.z_m + change[:, 0], v, np.asarray(readings.wrench))


def _added_noise(cell: CellRealisation) -> Floats:
    sigma = cell.noises
    sigma[[k - 1 for k in cell.silent if k]] = 0.0
    return sigma


@cache
def hosts_in(folder: Path | None, causes: Path | None) -> tuple[Host, ...]:
    """The hosts of a folder, read once a process.

    Args:
        folder: It holds X.csv and X.yaml; None: there are no hosts.
        causes: The file of causes; None: `causes.yaml` in the folder.
    """
    return () if folder is None else tuple(load_hosts(folder, causes))
