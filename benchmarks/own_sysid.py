"""Beside `mujoco.sysid`: hidden effects of rigs with simulators of their own, with all its candidates given to MuJoCo's identification.

`python -m benchmarks.own_sysid [--seed 3000] [--jobs 2] --kept FOLDER [--docs]` needs `pip install 'mujoco[sysid]'`. Recordings, and the
answers of palpd, are those of `benchmarks.own_simulators` and stand in the same FOLDER. sysid answers in two ways: all candidates in one
fit, and each alone, chosen by BIC against a fit that moves nothing but the stated tolerances. The better one counts.
"""

import argparse
import contextlib
import io
import json
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from absl import logging
from mujoco import sysid

import palpd
from benchmarks.own_models import MODELS, OwnRig
from benchmarks.own_simulators import PAGE, RecordingOf, answer_to, first, named, recordings, silent
from benchmarks.own_sysid_rollout import SIGNALS, Array, candidates, residual_function
from palpd.workers import pool

STEP = 1e-4
"""Step of sysid's finite differences; its default of 1e-8 is lost in MuJoCo's contact solver."""
ITERATIONS, TOLERANCE = 8, 1e-4
"""Most steps of a fit, and the relative reduction of its cost that ends it."""
THRESHOLDS = {
    "joint": (3, 5, 10, 15, 20, 30, 40, 60, 80),
    "joint, tolerances": (1, 2, 3, 5, 7, 10, 15, 20, 30, 40),
    "alone, BIC": (0, 10, 30, 100, 200, 300, 500, 700, 1000, 1500, 2000, 3000),
}
"""Least standard errors, or least drop of BIC, of an answer that names something; the best for sysid on these very recordings counts."""
TIE_BIC, TIE_CORRELATION = 30.0, 0.9
"""Candidates this close to the winner come first with it, as palpd's `indistinguishable_from` does; two parameters more cost 22."""
AGAIN = (0, 5, 9)
"""Recordings of each rig that palpd diagnoses again, for processor times of one run."""
HEADING = "## Beside mujoco.sysid"
INTRODUCTION = """
The same recordings, given to `mujoco.sysid` of MuJoCo 4.0.0. It fits a simulator's parameters by least squares. It gets the rig's simulator
as `custom_rollout`, palpd's estimate of the motion, and the noise of each channel as weights. Its candidates are the elements of MJCF and
of its `SignalTransform` that act like an effect (`benchmarks/own_sysid_rollout.py`).

| way of sysid | the answer |
|---|---|
| joint | all candidates in one fit: the one that lies most standard errors from nominal |
| joint, tolerances | the same, with the stated tolerance added to the standard error |
| alone, BIC | one fit for each candidate, beside the stated tolerances within two standard deviations: the one that lowers BIC most |

Each way has the threshold that is best for it on these recordings. Candidates that correlate above 0.9 with the winner, or have a BIC
within 30 of its, share the first place. *First* counts effects that a candidate expresses. *Right* counts all recordings. Times are of
recordings that both tools answered in one run.

Not asked: what a user could add to the rollout in code of his own, such as a drift of the sensor. sysid has no library of effects.

Again: `{command}`, after `pip install 'mujoco[sysid]'`.
"""
COLUMNS = ("tool", "first", "first, sysid cannot express", "healthy silent", "right", "processor time, median")


class Fitter:
    """Fits of a recording."""

    def __init__(self, rig: OwnRig, columns: Mapping[str, Array]) -> None:
        self.candidates = candidates(rig)
        self.residual = residual_function(rig, columns, self.parameters(dict.fromkeys(SIGNALS, False)))

    def parameters(self, chosen: Mapping[str, bool], *, shapes: bool = False) -> Any:
        """Parameters of some candidates; True keeps one within two standard deviations of a healthy rig."""
        fitted = sysid.ParameterDict()
        for name, within in chosen.items():
            candidate, nominal = self.candidates[name], 1.0 if name == "sensor gain" else 0.0
            low, high = (-2 * candidate.sigma, 2 * candidate.sigma) if within else (candidate.low, candidate.high)
            ones = np.ones(candidate.size)
            parameter = sysid.Parameter(name, nominal * ones, (nominal + low) * ones, (nominal + high) * ones)
            parameter.value = parameter.value + candidate.start
            fitted.add(parameter)
            if candidate.shape:
                fitted.add(sysid.Parameter(f"{name} shape", *candidate.shape, frozen=not shapes))
        # The signal transform asks for all of its parameters.
        for name in SIGNALS - set(chosen):
            fitted.add(sysid.Parameter(name, 1.0 if name == "sensor gain" else 0.0, -9.0, 9.0, frozen=True))
        return fitted

    def fit(self, parameters: Any) -> tuple[Any, Any, Array]:
        """Fitted parameters, sysid's result, and the residual in standard deviations of the noise."""
        with contextlib.redirect_stdout(io.StringIO()):
            fitted, result = sysid.optimize(
                parameters,
                self.residual,
                "scipy_parallel_fd",
                verbose=False,
                max_iters=ITERATIONS,
                x_scale="jac",
                diff_step=STEP,
                ftol=TOLERANCE,
            )
        return fitted, result, np.concatenate(self.residual(fitted.as_vector(), fitted)[0])

    def joint(self) -> dict[str, Any]:
        """Distance of each candidate from nominal with all in one fit: in standard errors, and in those with the tolerance; and likes."""
        fitted, result, residual = self.fit(self.parameters(dict.fromkeys(self.candidates, False)))
        with np.errstate(all="ignore"):
            covariance, errors = sysid.calculate_intervals([residual], result.jac, alpha=0.31731)
            correlation = np.abs(covariance) / np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
        names = [name for name, parameter in fitted.items() if not parameter.frozen for _ in range(parameter.size)]
        moved = np.abs(fitted.as_vector() - fitted.as_nominal_vector())
        rows = list(zip(names, moved, errors, strict=True))
        sigma = {name: candidate.sigma for name, candidate in self.candidates.items()}
        alike = np.argwhere(np.triu(correlation > TIE_CORRELATION, 1)).tolist()
        return {
            "joint": {name: max(float(x / e) for n, x, e in rows if n == name) for name in self.candidates},
            "joint, tolerances": {
                name: max(float(x / np.hypot(e, sigma[name])) for n, x, e in rows if n == name) for name in self.candidates
            },
            "alike": [[names[one], names[other]] for one, other in alike],
            "fitted": {name: parameter.value.tolist() for name, parameter in fitted.items()},
        }

    def alone(self) -> dict[str, float]:
        """By how much each candidate lowers BIC, alone beside the tolerances."""
        chosen = {name: True for name, candidate in self.candidates.items() if candidate.sigma}
        healthy, _, residual = self.fit(self.parameters(chosen))

        def bic(name: str) -> float:
            start = self.parameters(chosen | {name: False}, shapes=True)
            for other in chosen:
                start[other].value = healthy[other].value.copy()
            fitted, _, residual = self.fit(start)
            return float(residual.size * np.log(np.mean(residual**2)) + fitted.size * np.log(residual.size))

        least = float(residual.size * np.log(np.mean(residual**2)) + healthy.size * np.log(residual.size))
        return {name: least - bic(name) for name in self.candidates}


def sysid_answer(case: RecordingOf, seed: int, kept: Path) -> dict[str, Any]:
    """What both ways say of a recording, with processor times, and palpd's answer to it."""
    theirs = answer_to(case, seed, kept)
    file = kept / f"sysid-{case.model.replace(' ', '_')}-{case.number}.json"
    if file.exists():
        theirs |= json.loads(file.read_text(encoding="utf-8"))
        return theirs
    model = MODELS[case.model]
    columns = model.record(case.effect, seed + case.number).columns
    began = time.process_time()
    out: dict[str, Any] = Fitter(model.rig, columns).joint()
    out["joint_cpu_s"], began = time.process_time() - began, time.process_time()
    out["alone, BIC"] = Fitter(model.rig, columns).alone()
    out["alone_cpu_s"] = time.process_time() - began
    if case.number in AGAIN:
        began = time.process_time()
        palpd.diagnose(columns, json.loads(json.dumps(model.cell)), simulated=model.simulate).to_json()
        out["palpd_cpu_s"] = time.process_time() - began
    file.write_text(json.dumps(out), encoding="utf-8")
    return theirs | out


def group(row: Mapping[str, Any], way: str, threshold: float) -> set[str]:
    """Effects that come first in an answer of sysid; none: healthy."""
    scores: dict[str, float] = row[way]
    best = max(scores, key=scores.__getitem__)
    if scores[best] < threshold:
        return set()
    if way.startswith("alone"):
        names = {name for name, score in scores.items() if score >= scores[best] - TIE_BIC}
    else:
        names = {best}.union(*(pair for pair in row["alike"] if best in pair))
    of_rig = candidates(MODELS[row["model"]].rig)
    return {effect for name in names if name in of_rig for effect in of_rig[name].effects}


def expressible(row: Mapping[str, Any]) -> bool:
    """Whether a candidate of the rig stands for the planted effect."""
    return any(row["effect"] in candidate.effects for candidate in candidates(MODELS[row["model"]].rig).values())


def is_right(row: Mapping[str, Any], way: str, threshold: float) -> bool:
    """Whether an answer has the truth first, or is silent on a healthy recording; `way` "palpd" stands for palpd's."""
    if way == "palpd":
        return first(row) if row["effect"] else silent(row)
    answer = group(row, way, threshold)
    return row["effect"] in answer if row["effect"] else not answer


def best_threshold(rows: Sequence[Mapping[str, Any]], way: str) -> float:
    """The threshold with which sysid is right most often on these rows."""
    return max(THRESHOLDS[way], key=lambda threshold: sum(is_right(row, way, threshold) for row in rows))


def cells(rows: Sequence[Mapping[str, Any]], way: str, threshold: float) -> str:
    """Cells of a table: first of what sysid can express, of what it cannot, healthy silent, and processor time of the same recordings."""
    planted, healthy = [row for row in rows if row["effect"]], [row for row in rows if not row["effect"]]
    shares = [[row for row in planted if expressible(row)], [row for row in planted if not expressible(row)], healthy, rows]
    counts = [f"{sum(is_right(row, way, threshold) for row in share)} of {len(share)}" for share in shares]
    key = "palpd_cpu_s" if way == "palpd" else "alone_cpu_s" if way.startswith("alone") else "joint_cpu_s"
    return " | ".join([*counts, f"{np.median([row[key] for row in rows if 'palpd_cpu_s' in row]):.1f} s"])


def tables(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Lines of the page: both tools, each rig, what sysid cannot express, and disagreements."""
    head = ["", "| rigs | " + " | ".join(COLUMNS) + " |", "|" + "---|" * (len(COLUMNS) + 1)]
    chosen: dict[str, tuple[str, float]] = {}
    lines, rigs = head[1:], list(head)
    for title, models in {"the MuJoCo models": [name for name in MODELS if name.startswith("mujoco")], "all ten": list(MODELS)}.items():
        mine = [row for row in rows if row["model"] in models]
        ways = {way: best_threshold(mine, way) for way in THRESHOLDS}
        lines.append(f"| {title} | palpd | {cells(mine, 'palpd', 0)} |")
        lines += [f"| {title} | sysid {way}, from {least:g} | {cells(mine, way, least)} |" for way, least in ways.items()]
        best = max(ways.items(), key=lambda item: sum(is_right(row, *item) for row in mine))
        chosen = dict.fromkeys(models, best) | chosen
    disagreements = []
    for name, way in chosen.items():
        mine = [row for row in rows if row["model"] == name]
        rigs += [f"| {name} | palpd | {cells(mine, 'palpd', 0)} |", f"| {name} | sysid {way[0]} | {cells(mine, *way)} |"]
        for row in mine:
            if (ours := is_right(row, "palpd", 0)) != is_right(row, *way):
                answers = {"palpd": sorted(set().union(*named(row)[:1])), "sysid": sorted(group(row, *way))}
                both = ", ".join(f"{tool}: {' or '.join(f'`{one}`' for one in names) or 'nothing'}" for tool, names in answers.items())
                disagreements.append(f"| {name} | {row['effect'] or 'healthy'} | {'palpd' if ours else 'sysid'} | {both} |")
    missing = sorted({f"`{row['effect']}`" for row in rows if row["effect"] and not expressible(row)})
    lines += [*rigs, "", f"No candidate of sysid expresses {', '.join(missing)}.", "", "Where one tool is right and the other is not:", ""]
    return [*lines, "| rig | truth | right | named first |", "|---|---|---|---|", *disagreements]


def main() -> None:
    """Print the section, or write it to the page."""
    parser = argparse.ArgumentParser(description="Hidden effects of rigs with simulators of their own, beside mujoco.sysid.")
    parser.add_argument("--seed", type=int, default=3000)
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--kept", type=Path, required=True, help="folder of the answers of both, and of those of own_simulators")
    parser.add_argument("--docs", action="store_true", help=f"write the section of {PAGE.name}")
    options = parser.parse_args()
    options.kept.mkdir(parents=True, exist_ok=True)
    logging.set_verbosity(logging.ERROR)
    with pool(options.jobs) as workers:
        rows = list(workers.map(partial(sysid_answer, seed=options.seed, kept=options.kept), recordings(), chunksize=1))
    lines = tables(rows)
    if options.docs:
        text = INTRODUCTION.format(command=f"python -m benchmarks.own_sysid --seed {options.seed} --jobs 2 --kept FOLDER --docs")
        before = PAGE.read_text(encoding="utf-8").partition(f"\n{HEADING}\n")[0]
        PAGE.write_text("\n".join([before, HEADING, text, *lines, ""]), encoding="utf-8")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
