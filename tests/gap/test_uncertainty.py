"""What a diagnosis leaves open holds the truth as often as it says, parameters and deviations together."""

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom, chi2

from palpd.cell.cell_file import CROSSTALK, OpenHypothesis, load_cell, save_cell
from palpd.cell.draws import spread
from palpd.gap.diagnosis import diagnose
from palpd.gap.infer.evidence import fit
from palpd.gap.laws.evidence import FitBeside
from palpd.gap.model.linearise import linearise
from palpd.gap.model.problem import NOMINAL_ETA, Problem, make_problem
from palpd.gap.uncertainty import open_hypothesis
from palpd.testing.plain_cells import cell_of, recording
from tests.gap.test_intervals import DRAWS, SIZES, drawn

INSIDE = 0.95


@pytest.fixture(scope="module")
def problem() -> Problem:
    return make_problem([recording("second order", 3)], cell_of("second order"), max_bins=400)


def off(hypothesis: OpenHypothesis, true: dict[str, float]) -> np.ndarray:
    """How far the truth is from the centre, in independent standard normal numbers if the hypothesis is right."""
    moves = []
    for one in hypothesis.open:
        effect, _, name = one.name.rpartition(".")
        if effect != "estimated":
            centre = hypothesis.effects[effect][name]
        elif name in CROSSTALK:
            centre = hypothesis.estimated.crosstalk[CROSSTALK.index(name)]
        else:
            centre = getattr(hypothesis.estimated, name)
        value = true[one.name]
        moves.append({"linear": value - centre, "log": np.log(value / max(centre, 1e-300)) if one.scale == "log" else 0.0,
                      "log1p": np.log((1.0 + value) / (1.0 + centre)) if one.scale == "log1p" else 0.0}[one.scale])  # fmt: skip
    return np.linalg.solve(spread(hypothesis), np.array(moves))


def test_parameters_and_deviations_lie_together_where_the_uncertainty_says(problem: Problem) -> None:
    random = np.random.default_rng(5)
    inside = []
    for name, ranges in SIZES.items():
        for _ in range(DRAWS):
            values = {parameter: float(random.uniform(*bounds)) for parameter, bounds in ranges.items()}
            state = random.bit_generator.state
            data = drawn(problem, {name: values}, random)
            random.bit_generator.state = state
            eta = random.standard_normal(len(NOMINAL_ETA))
            start = {name: {parameter: 1.2 * value for parameter, value in values.items()}}
            one = fit(data, start, linearise(data, start, NOMINAL_ETA), rounds=3)
            hypothesis = open_hypothesis(data, FitBeside.nothing(one), 1.0, [])
            estimated = problem.estimated(eta)
            truth = {f"estimated.{key}": value for key, value in estimated.model_dump().items() if key != "crosstalk"}
            truth |= {f"estimated.{key}": value for key, value in zip(CROSSTALK, estimated.crosstalk, strict=True)}
            truth |= {f"{name}.{parameter}": value for parameter, value in values.items()}
            known = [k for k, number in enumerate(hypothesis.open) if number.name.rpartition(".")[2] not in ("bias_N", "drift_N_per_min")]
            kept = OpenHypothesis(
                probability=1.0,
                effects=hypothesis.effects,
                estimated=hypothesis.estimated,
                open=tuple(hypothesis.open[k] for k in known),
                correlation=tuple(tuple(hypothesis.correlation[k][j] for j in known) for k in known),
            )
            away = off(kept, truth)
            inside.append(float(away @ away) <= chi2.ppf(INSIDE, len(away)))
    n = len(inside)
    assert n == len(SIZES) * DRAWS
    # The parameters allow for laws that are off, so exact ones may lie inside more often.
    assert inside.count(False) <= binom.ppf(0.999, n, 1.0 - INSIDE)


def test_a_diagnosis_writes_what_it_leaves_open_and_a_simulation_does_not_care(tmp_path: Path) -> None:
    diagnosis = diagnose([recording("second order", 3)], cell_of("second order"), max_bins=400, propose=False)
    cell = diagnosis.cell_with_uncertainty()
    first, *others = cell.uncertainty
    assert first.effects == cell.effects
    assert first.estimated == cell.estimated
    assert sum(one.probability for one in cell.uncertainty) == pytest.approx(1.0)
    assert all(one.probability <= first.probability for one in others)
    save_cell(tmp_path / "enriched.yaml", cell)
    assert load_cell(tmp_path / "enriched.yaml") == cell
    assert cell.model_copy(update={"uncertainty": ()}) == diagnosis.enriched_cell()
    assert diagnosis.to_json()["uncertainty"][0]["probability"] == first.probability
