"""Writes what other machines record, to try `palpd import` with: a table in mm and mN with decimal commas, or a ROS 2 bag.

    python docs/examples/foreign_press.py press.csv
    python docs/examples/foreign_press.py press_bag

Both hold presses on a tissue that relaxes (tissue.viscoelastic, ratio 0.35, tau 1 s), so a diagnosis has something to find.
"""

import sys
from pathlib import Path

import numpy as np

from palpd.cell.cell_file import cell_from
from palpd.cell.simulation import simulate

RATE_HZ = {"csv": 100, "bag": 500}
TISSUE_Z_M = 0.1
CELL = {
    "probe": {"mass_kg": 0.1, "tip_radius_m": 0.004},
    "sensor": {"filter_cutoff_Hz": None, "noise_rms_N": 0.01, "resolution_fz_N": 0.002},
    "robot": {"position_noise_rms_m": 2e-6},
    "tissue": {"surface_z_m": TISSUE_Z_M, "youngs_modulus_Pa": 40000},
    "effects": {"tissue.viscoelastic": {"ratio": 0.35, "tau_s": 1.0}},
}


def press(kind):
    """Times, heights, speeds and wrench of four presses with holds."""
    t_s = np.arange(24 * RATE_HZ[kind]) / RATE_HZ[kind]
    depth_m = 0.002 + 0.001 * np.floor(t_s / 6.0)
    way = np.interp(t_s % 6.0, [0.0, 1.0, 2.0, 4.5, 5.2], [0.0, 0.0, 1.0, 1.0, 0.0])
    out = simulate(cell_from(CELL, "the example"), t_s, z_cmd_m=TISSUE_Z_M + 0.002 - (0.002 + depth_m) * way, noise_seed=1)
    wrench = np.column_stack([out[name] for name in ("fx_N", "fy_N", "fz_N", "tx_Nm", "ty_Nm", "tz_Nm")])
    return t_s, out["z_m"], out["vz_m_per_s"], wrench


def write_table(path):
    """A table as a testing machine in Europe writes it; pressing is negative."""
    t_s, z_m, _, wrench = press("csv")
    rows = [f"{t:.2f};{1e3 * z:.4f};{-1e3 * f:.1f}".replace(".", ",") for t, z, f in zip(t_s, z_m, wrench[:, 2], strict=True)]
    text = "\n".join(["Machine;ZP-20", "Time (s);Height (mm);Force (mN)", *rows, "end of test", ""])
    if path.exists() and path.read_text() != text:
        sys.exit(f"{path} exists and holds something else; give another name")
    path.write_text(text)


def write_bag(path):
    """A bag with a wrench in axes of the tool at 500 Hz beside a pose at 125 Hz, whose quaternion sometimes flips its sign."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    if path.exists():
        print(f"{path} exists already and is kept")
        return
    t_s, z_m, vz_m_per_s, wrench = press("bag")
    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    vector, point, turn = (types[f"geometry_msgs/msg/{name}"] for name in ("Vector3", "Point", "Quaternion"))

    def header(ns, frame):
        return types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](ns // 10**9, ns % 10**9), frame)

    kinds = {"/ft_sensor/wrench": "WrenchStamped", "/tcp/pose": "PoseStamped", "/tcp/twist": "TwistStamped"}
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = {
            topic: (writer.add_connection(topic, f"geometry_msgs/msg/{kind}", typestore=store), f"geometry_msgs/msg/{kind}")
            for topic, kind in kinds.items()
        }

        def write(topic, ns, *content):
            connection, kind = topics[topic]
            frame = "tool0" if topic == "/ft_sensor/wrench" else "base"
            writer.write(connection, ns, store.serialize_cdr(types[kind](header(ns, frame), *content), kind))

        for k, ns in enumerate((1_700_000_000_000_000_000 + np.rint(t_s * 1e9).astype(int)).tolist()):
            fx, fy, fz, tx, ty, tz = wrench[k].tolist()
            in_tool = vector(fx, -fy, -fz), vector(tx, -ty, -tz)  # the tool is turned by 180° about x: its z points down
            write("/ft_sensor/wrench", ns, types["geometry_msgs/msg/Wrench"](*in_tool))
            if k % 4 == 0:
                sign = -1.0 if k % 3 == 0 else 1.0
                place, turned = point(0.4, -0.1, float(z_m[k])), turn(sign, 0.0, 0.0, 0.0)
                write("/tcp/pose", ns, types["geometry_msgs/msg/Pose"](place, turned))
                speed = vector(0.0, 0.0, float(vz_m_per_s[k]))
                write("/tcp/twist", ns, types["geometry_msgs/msg/Twist"](speed, vector(0.0, 0.0, 0.0)))


if __name__ == "__main__":
    out = Path(sys.argv[1])
    write_table(out) if out.suffix == ".csv" else write_bag(out)
