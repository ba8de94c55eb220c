"""Questions by seed: effects of the arena's own laws, planted into healthy recordings of its rigs."""

import json
import shutil
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from palpd.arena.cases import ArenaRig, Question
from palpd.arena.columns import JOINT, Columns, Floats, Healthy, load
from palpd.arena.laws import LAWS
from palpd.arena.planted import PlantingRefusedError, plant
from palpd.arena.signals import MEAN_S, smooth
from palpd.errors import BadInput
from palpd.files import check_folder

SNR = (10.0, 60.0)
"""Range of the SNR beyond what the healthy recordings do."""
LEAST_TIMES = 3.0
"""How many times as large an effect is as what the healthy recordings show of it beside each other: a smaller one is as usual as not."""
EACH = 10
"""Questions planted into each rig, where nothing else is asked."""
ALIKE = {
    "sensor.latency": "sensor.latency|sensor.filter",
    "sensor.filter": "sensor.filter|sensor.latency",
    "sensor.gain": "sensor.gain|tissue.modulus",
    "sensor.warmup": "sensor.warmup|sensor.drift|sensor.creep",
    "sensor.drift": "sensor.drift|sensor.warmup|sensor.creep",
    "sensor.creep": "sensor.creep|tissue.viscoelastic",
}
"""Names that count as well, where hardly any recording can tell them apart."""


def plant_all(rigs: Sequence[ArenaRig], folder: Path, seed: int, number: int | None) -> int:
    """Write rigs whose questions are healthy recordings with a planted effect, one effect each, and give their number.

    Args:
        folder: It gets a folder for each rig, in the form of `benchmarks/arena`.
        number: How many questions in all; None: EACH for every rig.

    Raises:
        BadInput: The folder is not empty, or no rig has a healthy recording to plant into.
    """
    check_folder(folder, empty=True)
    hosts = [rig for rig in rigs if rig.healthy]
    if not hosts:
        raise BadInput("no rig has a healthy recording to plant into")
    targets = [0] * len(hosts)
    for k in range(EACH * len(hosts) if number is None else number):
        targets[k % len(hosts)] += 1
    return sum(
        _plant(rig, folder / rig.name, np.random.default_rng([seed, k]), count)
        for k, (rig, count) in enumerate(zip(hosts, targets, strict=True))
    )


def _plant(rig: ArenaRig, folder: Path, random: np.random.Generator, count: int) -> int:
    shutil.copytree(rig.folder, folder, ignore=shutil.ignore_patterns("recordings", "truth.json", "convert.py", "README.md", "*.png"))
    (folder / "recordings").mkdir()
    for path in rig.questions[0].healthy:
        shutil.copy(path, folder / "recordings")
    references = [load(path) for path in rig.questions[0].healthy]
    usual = Healthy.of(references)
    beside = beside_each_other(references)
    truths: dict[str, dict[str, Any]] = {}
    laws = list(random.permutation(list(LAWS)))
    hosts: cycle[Question] = cycle(random.permutation(np.array(rig.healthy, dtype=object)).tolist())
    for law in laws * 3:
        if len(truths) == count:
            break
        host = next(hosts)
        recording = load(host.recording)
        try:
            planted = plant(recording, law, random, SNR, sigma_N=noise_beside(usual, references, recording))
        except PlantingRefusedError:
            continue
        if np.ptp(planted.columns["fz_N"]) == 0.0:
            continue  # saturated throughout: no recording of anything
        times = times_usual(law, planted.parameters, beside)
        if times < LEAST_TIMES:
            continue  # what the rig does by itself
        name = f"p{len(truths) + 1}.csv"
        _write(folder / "recordings" / name, planted.columns, joint="angle_rad" in host.recording.read_text().split("\n", 1)[0])
        cause = "unknown" if law.startswith("unknown.") else ALIKE.get(law, law)
        truths[name] = {
            "truth": law,
            "causes": [cause],
            "known": "planted",
            "size": {key: float(value) for key, value in planted.parameters.items()},
            "snr": planted.snr,
            "times_usual": times if np.isfinite(times) else None,  # JSON has no infinity
            "why": f"planted into {host.name}",
        }
    stated = yaml.safe_load((folder / "rig.yaml").read_text(encoding="utf-8"))
    stated |= {"judged": list(truths), "shipped": True}
    (folder / "rig.yaml").write_text(yaml.safe_dump(stated, sort_keys=False, allow_unicode=True), encoding="utf-8")
    (folder / "truth.json").write_text(json.dumps(truths, indent=1), encoding="utf-8")
    return len(truths)


def noise_beside(usual: Healthy, references: Sequence[Columns], recording: Columns) -> float:
    """Noise of a sample, in N, that has as much energy over 20 ms as what does not repeat in the healthy recordings.

    Args:
        usual: What the healthy rig does.
        recording: The one to plant into.
    """
    samples = _samples_of_a_mean(recording)
    squares = [float(np.nanmean(_means(usual.residual(each), samples) ** 2)) for each in references]
    return float(np.sqrt(np.mean(squares) * samples))


def beside_each_other(references: Sequence[Columns]) -> list[tuple[Columns, Floats]]:
    """Each healthy recording without the noise of its force, and its residual (n,) in N beside the others; none of a single one."""
    if len(references) < 2:
        return []
    others = ([*references[:k], *references[k + 1 :]] for k in range(len(references)))
    return [({**one, "fz_N": smooth(one["fz_N"])}, Healthy.of(rest).residual(one)) for one, rest in zip(references, others, strict=True)]


def times_usual(law: str, parameters: Mapping[str, float], beside: Sequence[tuple[Columns, Floats]]) -> float:
    """How many times as large an effect is as what healthy recordings show of it; infinite where none shows any.

    In each the same law makes a change of its own, and the share of it that stands in the residual is fitted by least squares.

    Args:
        beside: The recordings and their residuals (n,) in N, as `beside_each_other` gives them.
    """
    squares = []
    for bare, left in beside:
        try:
            change = np.nan_to_num(LAWS[law].apply(bare, parameters).get("fz_N", bare["fz_N"]) - bare["fz_N"])
        except PlantingRefusedError:
            continue
        samples = _samples_of_a_mean(bare)
        planted, shown = _means(change, samples), _means(left, samples)
        known = np.isfinite(shown)
        if planted[known].any():
            squares.append(float(shown[known] @ planted[known] / (planted[known] @ planted[known])) ** 2)
    return float(np.mean(squares) ** -0.5) if any(squares) else float("inf")


def _samples_of_a_mean(recording: Columns) -> int:
    t_s = recording["t_s"]
    return max(1, round(MEAN_S * (len(t_s) - 1) / float(np.ptp(t_s))))


def _means(values: Floats, samples: int) -> Floats:
    whole = len(values) // samples * samples
    return np.asarray(values[:whole].reshape(-1, samples).mean(axis=1))


def _write(path: Path, columns: Columns, *, joint: bool) -> None:
    names = {axis: name for name, axis in JOINT.items()} if joint else {}
    kept = [name for name in ("t_s", "z_m", "fz_N", "z_cmd_m") if name in columns]
    values = np.column_stack([columns[name] for name in kept])
    np.savetxt(path, values, delimiter=",", header=",".join(names.get(name, name) for name in kept), comments="", fmt="%.7g")
