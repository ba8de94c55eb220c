"""Whatever stands in a file, or comes from a controller: it is read, or refused with a sentence of ours. Nothing else is ever raised."""

import json
import socket
import struct
import threading
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from hw.rtde import _greet
from palpd.cell.cell_file import load_cell
from palpd.config import load_config, load_plan, parse_plan
from palpd.control.inertial import InertialModel
from palpd.daemon.stored_state import State
from palpd.errors import PalpdError
from palpd.recording.reader import Recording
from palpd.recording.recovery import recover
from palpd.recording.samples import read_csv
from tests.recording.test_recording import random_rows, write

few = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
scalars = (
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.sampled_from(["A", "both", "ur5", "1e3", ".nan"])
)
words = (
    "robot", "sensor", "safety", "sites", "mode", "depths_m", "press_speed_m_per_s", "repeats", "hold_s", "search", "cell", "probe",
    "tissue", "wall", "effects", "name", "x_m", "y_m", "host", "model", "contact_limit_N", "absolute_limit_N", "workspace_m", "path",
    "max_travel_m", "speed_m_per_s", "mass_kg", "parameters", "stiffness_N_per_m", "ci95_N_per_m", "wrench", "reason", "date",
)  # fmt: skip
keys = st.sampled_from(words) | st.text(max_size=6)
values = st.recursive(scalars, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(keys, inner, max_size=5), max_leaves=20)


def refused_or_read(read: Any, *arguments: Any, **more: Any) -> None:
    """Only our own errors, and they hold a sentence."""
    sentence = "it was read"
    try:
        read(*arguments, **more)
    except PalpdError as error:
        sentence = str(error)
    assert len(sentence) > 10


@given(values)
@few
def test_any_data_is_a_plan_or_refused(data: Any) -> None:
    refused_or_read(parse_plan, data, "the plan")


@pytest.mark.parametrize("read", [load_config, load_plan, load_cell])
@given(data=values | st.binary(max_size=80))
@few
def test_any_yaml_file_is_read_or_refused(tmp_path: Path, read: Any, data: Any) -> None:
    path = tmp_path / "some.yaml"
    path.write_bytes(data if isinstance(data, bytes) else yaml.safe_dump(data).encode())
    refused_or_read(read, path)


@given(st.binary(max_size=200) | st.text(alphabet="t_sz_mfN,.;-+e0123456789\n\"'", max_size=200).map(str.encode))
@few
def test_any_table_is_read_or_refused(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "some.csv"
    path.write_bytes(b"t_s,z_m,z_cmd_m,fz_N\n" + data)
    refused_or_read(read_csv, path)
    path.write_bytes(data)
    refused_or_read(read_csv, path)


@given(st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=6), st.floats(0, 1))
@example(damage=[(0.5, 0), (0.001953125, 0)], kept=0.875)  # the header is lost, and a tick gives a time of 1e23 s
@few
def test_any_damage_to_a_recording_is_found_or_harmless(tmp_path: Path, damage: list[tuple[float, int]], kept: float) -> None:
    whole = tmp_path / "whole.mcap"
    if not whole.exists():
        write(whole, random_rows(1, [8] * 30))
    data = bytearray(whole.read_bytes())
    for share, byte in damage:
        data[int(share * len(data))] = byte
    for name in ("some.mcap", "some.part"):
        (tmp_path / name).write_bytes(data if name == "some.mcap" else data[: int(kept * len(data))])
    (tmp_path / "some.mcap").replace(tmp_path / "damaged.mcap")
    refused_or_read(Recording.load, tmp_path / "damaged.mcap")
    refused_or_read(recover, tmp_path / "some.part")
    for left in tmp_path.glob("some*"):
        left.unlink()


@given(st.binary(max_size=300), values)
@few
def test_any_file_is_a_model_or_refused(tmp_path: Path, graph: bytes, card: Any) -> None:
    path = tmp_path / "some.onnx"
    path.write_bytes(graph)
    path.with_suffix(".json").write_text(json.dumps(card))
    refused_or_read(InertialModel.load, path, probe_mass_kg=0.2)


@given(values | st.binary(max_size=60), st.sampled_from(["calibration", "stiffness", "latch"]))
@few
def test_any_kept_state_is_read_or_refused(tmp_path: Path, data: Any, name: str) -> None:
    (tmp_path / f"{name}.json").write_bytes(data if isinstance(data, bytes) else json.dumps(data).encode())
    state = State(tmp_path)
    refused_or_read({"calibration": state.calibration, "stiffness": state.machine_stiffness, "latch": state.latch}[name])


answers = st.lists(st.tuples(st.sampled_from(b"VvOSUMX"), st.binary(max_size=40)), max_size=8).map(
    lambda packages: b"".join(struct.pack(">HB", 3 + len(body), kind) + body for kind, body in packages)
)


@given(answers | st.binary(max_size=120))
@settings(max_examples=40, deadline=None)
def test_any_answers_of_a_controller_are_understood_or_refused(data: bytes) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server, pytest.MonkeyPatch.context() as patch:
        patch.setattr("hw.rtde.RTDE_PORT", server.getsockname()[1])

        def answer() -> None:
            with server.accept()[0] as connection:
                connection.sendall(data)
                connection.shutdown(socket.SHUT_WR)
                while connection.recv(4096):
                    pass

        thread = threading.Thread(target=answer, daemon=True)
        thread.start()
        refused_or_read(_greet, "127.0.0.1", "ur5")
        thread.join(5.0)
