"""Bags of three storages: imported columns are the truth, and what does not fit is one sentence that lists what is there."""

from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from palpd.errors import BadInput, PalpdError, RecordingError
from palpd.interchange.import_files import ImportOptions, import_files, read_files, source_of
from palpd.recording.samples import read_csv
from tests.interchange.bags import STORAGES, STRAIGHT_DOWN, Truth, bag, truth


@pytest.mark.parametrize("storage", STORAGES)
def test_columns_of_a_bag_are_the_truth(tmp_path: Path, storage: str) -> None:
    one = truth()
    out = tmp_path / "out.csv"
    imported = import_files([bag(tmp_path, storage, one, late_ns=3_000_000)], ImportOptions(), out)
    samples = read_csv(out)
    last = int(np.searchsorted(one.wrench_ns, one.pose_ns[-1]))
    assert len(samples) == last + 1
    equal = np.flatnonzero(np.isin(one.wrench_ns[: last + 1], one.pose_ns))
    assert len(equal) == len(one.pose_ns)
    np.testing.assert_allclose(samples.t_s, (one.wrench_ns[: last + 1] - one.wrench_ns[0]) * 1e-9, rtol=0, atol=1e-9)
    np.testing.assert_allclose(samples.z_m[equal], one.pose[:, 2], rtol=0, atol=1e-9)
    np.testing.assert_allclose(samples.vz_m_per_s[equal], one.twist[:, 2], rtol=0, atol=1e-9)
    np.testing.assert_allclose(samples.wrench[equal], one.wrench[equal], rtol=0, atol=1e-9)
    assert any("came out of order" in note for note in imported.notes)
    assert any("axes of tool0 was turned into those of base" in note for note in imported.notes)


@pytest.mark.parametrize("storage", STORAGES)
def test_skewed_stamps_are_interpolated_between(tmp_path: Path, storage: str) -> None:
    one = truth(pose_skew_ns=2_300_001)
    samples = read_files([bag(tmp_path, storage, one, frames={"/wrench": "base"})], ImportOptions()).samples
    inside = (one.wrench_ns >= one.pose_ns[0]) & (one.wrench_ns <= one.pose_ns[-1])
    expected_m = np.interp((one.wrench_ns[inside] - one.pose_ns[0]) * 1e-9, (one.pose_ns - one.pose_ns[0]) * 1e-9, one.pose[:, 2])
    np.testing.assert_allclose(samples.z_m, expected_m, rtol=0, atol=1e-9)
    assert np.array_equal(samples.wrench, one.wrench[inside])  # already in base axes


def test_a_commanded_pose_becomes_the_commanded_height(tmp_path: Path) -> None:
    path = bag(tmp_path, "mcap", truth(), topics=("/wrench", "/pose", "/command"))
    samples = read_files([path], ImportOptions(pose="/pose", command="/command")).samples
    assert samples.z_cmd_m is not None
    assert np.array_equal(samples.z_cmd_m, samples.z_m)
    with pytest.raises(BadInput, match=r"2 channels with a pose \(/command, /pose\); give --pose"):
        read_files([path], ImportOptions())


@pytest.mark.parametrize("axis", ["x", "-y", "-z"])
def test_the_chosen_axis_becomes_z(tmp_path: Path, axis: str) -> None:
    one = truth(turn_deg=0.0)
    along = {"x": 0, "-y": 1, "-z": 2}[axis]
    sign = -1.0 if axis.startswith("-") else 1.0
    new_z = sign * np.eye(3)[along]
    new_x = np.eye(3)[(along + 1) % 3]
    turn = np.column_stack([new_x, np.cross(new_z, new_x), new_z])  # columns: our axes in those of the file

    def there(vectors: np.ndarray) -> np.ndarray:
        return (vectors.reshape(-1, 3) @ turn.T).reshape(vectors.shape)

    pose = np.column_stack([there(np.ascontiguousarray(one.pose[:, :3])), np.tile(STRAIGHT_DOWN, (len(one.pose), 1))])
    other = Truth(one.wrench_ns, there(one.wrench), one.pose_ns, pose, there(one.twist))
    samples = read_files([bag(tmp_path, "sqlite3", other, frames={"/wrench": "base"})], ImportOptions(axis=axis)).samples  # type: ignore[arg-type]
    equal = np.isin(one.wrench_ns[: len(samples)], one.pose_ns)
    np.testing.assert_allclose(samples.z_m[equal], one.pose[:, 2], rtol=0, atol=1e-9)
    np.testing.assert_allclose(samples.vz_m_per_s[equal], one.twist[:, 2], rtol=0, atol=1e-9)
    np.testing.assert_allclose(samples.wrench[:, [2, 5]], one.wrench[: len(samples)][:, [2, 5]], rtol=0, atol=1e-9)


def test_a_tool_that_turns_by_ten_degrees_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"the tool turns by 10\.0° up to row 250, expected at most 2°; cut the recording"):
        read_files([bag(tmp_path, "mcap", truth(turn_deg=10.0))], ImportOptions())


@pytest.mark.parametrize("storage", STORAGES)
def test_a_missing_topic_and_a_wrong_type_list_what_is_there(tmp_path: Path, storage: str) -> None:
    path = bag(tmp_path, storage, truth(0.5), topics=("/wrench", "/noise"))
    with pytest.raises(BadInput, match=r"there is no /ft in .*; it holds /noise \(geometry_msgs/msg/Vector3, .* Hz\), /wrench"):
        read_files([path], ImportOptions(wrench="/ft"))
    with pytest.raises(RecordingError, match=r"/noise is geometry_msgs/msg/Vector3, expected a wrench, a pose or a twist"):
        read_files([path], ImportOptions(pose="/noise"))
    with pytest.raises(BadInput, match=r"no topic holds a pose \(.* holds /noise .*, /wrench \(geometry_msgs/msg/WrenchStamped"):
        read_files([path], ImportOptions())


def test_topics_are_listed_with_types_and_rates(tmp_path: Path) -> None:
    listed = {each.name: each for each in source_of(bag(tmp_path, "ros1", truth(1.0))).channels}
    assert {name: each.kind for name, each in listed.items()} == {"/wrench": "wrench", "/pose": "pose", "/twist": "twist"}
    assert listed["/wrench"].rate_Hz == pytest.approx(1000.0, rel=0.01)


def test_a_twist_of_something_else_is_not_used(tmp_path: Path) -> None:
    one = truth()
    other = Truth(one.wrench_ns, one.wrench, one.pose_ns, one.pose, one.twist * 3.0)
    path = bag(tmp_path, "mcap", other)
    imported = read_files([path], ImportOptions())
    assert any("/twist is not the speed of /pose" in note for note in imported.notes)
    slope = np.gradient(one.pose[:, 2], (one.pose_ns - one.pose_ns[0]) * 1e-9)
    equal = np.isin(one.wrench_ns[: len(imported.samples)], one.pose_ns)
    np.testing.assert_allclose(imported.samples.vz_m_per_s[equal], slope, rtol=0, atol=1e-9)
    with pytest.raises(BadInput, match=r"z_m changes 0\.333 times as fast as vz_m_per_s says"):
        read_files([path], ImportOptions(twist="/twist"))
    named = read_files([path], ImportOptions(twist="/twist", accept_implausible=True)).samples
    np.testing.assert_allclose(named.vz_m_per_s[equal], 3.0 * one.twist[:, 2], rtol=0, atol=1e-9)


def test_two_clocks_in_a_bag_are_one_sentence_and_an_offset_joins_them(tmp_path: Path) -> None:
    one = truth(pose_skew_ns=3_600 * 10**9)
    path = bag(tmp_path, "sqlite3", one, frames={"/wrench": "base"})
    with pytest.raises(BadInput, match=r"so they have two clocks; give --offset-s, .*\(3600 lets both begin together\)"):
        read_files([path], ImportOptions())
    samples = read_files([path], ImportOptions(offset_s=3600.0)).samples
    assert samples.z_m[0] == pytest.approx(one.pose[0, 2], abs=1e-9)


def test_transforms_are_read_by_their_frame(tmp_path: Path) -> None:
    one = truth(1.0)
    path = tmp_path / "tf"
    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    kinds = {"/tf": "tf2_msgs/msg/TFMessage", "/wrench": "geometry_msgs/msg/WrenchStamped"}

    def header(stamp_ns: int, frame: str) -> object:
        stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)

    vector, turn = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    with Writer2(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in kinds.items()}
        for stamp_ns, row in zip(one.pose_ns.tolist(), one.pose.tolist(), strict=True):
            transforms = [
                types["geometry_msgs/msg/TransformStamped"](
                    header(stamp_ns, "base"), child, types["geometry_msgs/msg/Transform"](vector(*row[:3]), turn(*row[3:]))
                )
                for child in ("tool0", "elbow")
            ]
            raw = store.serialize_cdr(types[kinds["/tf"]](transforms), kinds["/tf"])
            writer.write(connections["/tf"], stamp_ns, raw)
        for stamp_ns, row in zip(one.wrench_ns.tolist(), one.wrench.tolist(), strict=True):
            wrench = types["geometry_msgs/msg/Wrench"](vector(*row[:3]), vector(*row[3:]))
            content = types[kinds["/wrench"]](header(stamp_ns, "base"), wrench)
            writer.write(connections["/wrench"], stamp_ns, store.serialize_cdr(content, kinds["/wrench"]))
    samples = read_files([path], ImportOptions(pose="/tf:tool0")).samples
    np.testing.assert_allclose(samples.z_m[::8], one.pose[: len(samples.z_m[::8]), 2], rtol=0, atol=1e-9)
    with pytest.raises(RecordingError, match=r"/tf holds no frame hand; give --pose /tf:FRAME with one of elbow, tool0"):
        read_files([path], ImportOptions(pose="/tf:hand"))
    with pytest.raises(BadInput, match="--pose TOPIC:FRAME"):
        read_files([path], ImportOptions())


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("share", [0.0, 0.3, 0.97])
def test_a_truncated_bag_is_refused_and_nothing_is_written(tmp_path: Path, storage: str, share: float) -> None:
    path = bag(tmp_path, storage, truth(0.5))
    file = path if path.is_file() else next(each for each in path.iterdir() if each.suffix in (".db3", ".mcap"))
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    out = tmp_path / "out.csv"
    for each in (path, file):
        with pytest.raises(PalpdError) as refusal:
            import_files([each], ImportOptions(), out)
        assert "\n" not in str(refusal.value)
    assert not out.exists()


def test_columns_beside_a_pose_are_refused_and_not_ignored(tmp_path: Path) -> None:
    path = bag(tmp_path, "mcap", truth(0.5))
    with pytest.raises(BadInput, match="--column z_cmd_m belongs to --height-column or --depth-column; with a pose give"):
        read_files([path], ImportOptions(columns={"z_cmd_m": "x"}))
    with pytest.raises(BadInput, match="--column fx_N belongs to --force-column; a wrench holds all six axes"):
        read_files([path], ImportOptions(columns={"fx_N": "x"}))
    with pytest.raises(BadInput, match="--force-column; a wrench is in N and Nm"):
        read_files([path], ImportOptions(force_unit="mN"))
    with pytest.raises(BadInput, match="belong to columns; a pose is in m, and --axis -z turns it"):
        read_files([path], ImportOptions(length_unit="mm"))


def test_a_wrench_without_a_frame_asks_for_its_axes(tmp_path: Path) -> None:
    one = truth(0.5)
    path = bag(tmp_path, "ros1", one, frames={"/wrench": ""})
    with pytest.raises(BadInput, match="nothing says in which axes the wrench is; give --wrench-in tool or --wrench-in base"):
        read_files([path], ImportOptions())
    samples = read_files([path], ImportOptions(wrench_in="tool")).samples
    equal = np.isin(one.wrench_ns[: len(samples)], one.pose_ns)
    np.testing.assert_allclose(samples.wrench[equal], one.wrench[: len(samples)][equal], rtol=0, atol=1e-9)


def test_an_empty_topic_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "empty.bag"
    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer1(path) as writer:
        writer.add_connection("/wrench", "geometry_msgs/msg/WrenchStamped", typestore=store)
        writer.add_connection("/pose", "geometry_msgs/msg/PoseStamped", typestore=store)
    with pytest.raises(RecordingError):
        read_files([path], ImportOptions())


def test_a_straight_tool_is_straight() -> None:
    assert np.allclose(Rotation.from_quat(STRAIGHT_DOWN).apply([0.0, 0.0, 1.0]), [0.0, 0.0, -1.0])


@pytest.mark.parametrize(("option", "topic"), [("wrench", "/pose"), ("pose", "/wrench"), ("twist", "/pose"), ("command", "/twist")])
def test_a_topic_of_another_kind_is_refused(tmp_path: Path, option: str, topic: str) -> None:
    path = bag(tmp_path, "mcap", truth(0.5))
    with pytest.raises(BadInput, match=f"--{option} {topic}: it holds a {topic[1:]}, expected a {option}; .* holds"):
        read_files([path], ImportOptions(**{option: topic}))  # type: ignore[arg-type]
