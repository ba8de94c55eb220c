"""The card of a trained inertial model: what is known of it, stored beside it as JSON."""

import hashlib
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import sklearn

from palpd.compensation.cycles import SMOOTHING_S
from palpd.control.inertial import WINDOW_S, card_path
from palpd.errors import BadInput
from palpd.file_kinds import JSON, MODEL
from palpd.files import check_writable, file_use, write_bytes, write_json
from palpd.recording.samples import Samples

SMOOTHING: dict[str, Any] = {
    "training": "repeats averaged; centred moving average, twice, on features and force alike; features as at run time, "
    "but for the paper's network, whose features are smoothed over past and future",
    "training_window_s": SMOOTHING_S,
    "run_time": "slope of a line through the last robot states, causal",
    "run_time_window_s": WINDOW_S,
    "run_time_acceleration_delay_s": WINDOW_S / 2.0,
}
"""How features are smoothed in training and at run time, as it stands on every card."""


@dataclass(frozen=True, slots=True)
class ModelCard:
    """Facts of a trained model; intervals are 95 %.

    Attributes:
        input_range: Where the model may be asked: a network where it was trained, a linear law further.
        trained_range: The inputs that it was trained on.
        rmse_N: Error of the model over its `n` training points.
        bias_N: Constant part of the force.
        inertial_rms_N: Rms of the inertia -m a.
        other_rms_N: Rms of the output that is neither bias nor inertia.
        raw_rms_N: Scatter of single samples around the mean cycle.
        run_time_rms_N: Change of the output by the causal features of run time.
        mass_kg: Moving mass, by b - m a - c v fitted to the mean cycle, as are `bias_N` and `drag_N_s_per_m`.
        notes: Sentences that a reader should know before trusting the correction.
    """

    schema: str
    method: str
    inputs: list[dict[str, str]]
    input_range: dict[str, list[float]]
    trained_range: dict[str, list[float]]
    output: dict[str, str]
    rmse_N: float
    bias_N: float
    inertial_rms_N: float
    other_rms_N: float
    raw_rms_N: float
    run_time_rms_N: float
    mass_kg: float
    mass_ci95_kg: list[float]
    drag_N_s_per_m: float
    bias_ci95_N: list[float]
    n: int
    repeats: int
    recordings: int
    smoothing: dict[str, Any]
    sensor_delay_s: float
    probe: dict[str, float]
    sensor_serial: str | None
    data_sha256: str
    model_sha256: str
    versions: dict[str, str]
    date: str
    notes: list[str]


def software_versions() -> dict[str, str]:
    """Versions of the software that a trained model depends on."""
    return {"python": platform.python_version(), **{module.__name__: module.__version__ for module in (np, sklearn, onnx, onnxruntime)}}


def notes_of(card: dict[str, Any], samples: Samples) -> list[str]:
    """Sentences that a reader of the card should know before trusting the correction.

    Args:
        card: Fields of a card.
        samples: One of the recordings, for the count of its force.
    """
    bias_N, inertial_N = abs(card["bias_N"]), card["inertial_rms_N"]
    share = bias_N / (bias_N + inertial_N) if bias_N + inertial_N > 0 else 0.0
    notes = [f"{100.0 * share:.0f} % of the correction is bias ({card['bias_N']:+.3f} N), the rest inertia ({inertial_N:.4f} N rms)"]
    if share > 0.5:
        notes.append("a bias belongs to one tare and does not carry over to the next: tare again rather than subtract it")
    levels = np.unique(np.round(samples.wrench[:, 2], 9))
    count_N = float(np.median(np.diff(levels))) if 2 <= len(levels) <= 200 else 0.0
    if 0.0 < card["raw_rms_N"] < 0.45 * count_N:
        notes.append(
            f"samples scatter by {card['raw_rms_N']:.3f} N rms, less than noise that dithers a count of {count_N:.3f} N would: "
            "averages keep a rounding error of up to half a count"
        )
    if not card["mass_ci95_kg"][0] <= card["probe"]["mass_kg"] <= card["mass_ci95_kg"][1]:
        notes.append(f"the moving mass of {card['mass_kg']:.3f} kg found is not the probe's {card['probe']['mass_kg']:g} kg")
    return notes


def data_sha256(recordings: Sequence[Samples]) -> str:
    """Of time, height, speed and wrench of all recordings in their order, as little-endian float64."""
    digest = hashlib.sha256()
    for samples in recordings:
        for column in (samples.t_s, samples.z_m, samples.vz_m_per_s, samples.wrench):
            digest.update(np.ascontiguousarray(column, dtype="<f8").tobytes())
    return digest.hexdigest()


def refuse_place(out: Path) -> None:
    """Refuse a place where a model and its card cannot be written, before any work.

    Raises:
        BadInput: The name is not that of a model, or one of both files cannot be written or may not be replaced.
    """
    if out.suffix != ".onnx":
        raise BadInput(
            f"the model's file is to be {str(out)!r}, expected a name that ends in .onnx; its card is written beside it as .json"
        )
    with file_use():
        check_writable(out, kind=MODEL)
        check_writable(card_path(out), kind=JSON)


def write_model(out: Path, content: bytes, card: ModelCard) -> None:
    """Write a model and its card beside it.

    Args:
        content: The model as ONNX.

    Raises:
        BadInput: A file cannot be written.
    """
    write_bytes(out, content)
    write_json(card_path(out), asdict(card))
