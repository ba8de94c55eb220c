"""Makes recordings/ from a checkout of github.com/dfki-ric-underactuated-lab/double_pendulum: python convert.py FOLDER."""

import sys
from pathlib import Path

import numpy as np
from scipy.signal import resample_poly

DATA = Path(sys.argv[1]) / "leaderboard"
OUT = Path(__file__).parent / "recordings"
JOINT = 2  # the joint that has a motor; the other one swings freely
RATE_HZ, EVERY = 400, 4
RECORDINGS = {
    "h1.csv": "acrobot/real_hardware_v2/src_data/ilqr_tvlqr_lqr/experiment01/trajectory.csv",
    "h2.csv": "acrobot/real_hardware_v2/src_data/ilqr_tvlqr_lqr/experiment02/trajectory.csv",
    "h3.csv": "acrobot/real_hardware_v2/src_data/ilqr_tvlqr_lqr/experiment03/trajectory.csv",
    "h4.csv": "acrobot/real_hardware_v2/src_data/ilqr_tvlqr_lqr/experiment04/trajectory.csv",
    "j1.csv": "acrobot/real_hardware_v2/src_data/ilqr_tvlqr_lqr/experiment08/trajectory.csv",
    "j2.csv": "acrobot/real_hardware_v2/src_data/ilqr_tvlqr_lqr/experiment09/trajectory.csv",
    "j3.csv": "acrobot/real_hardware_v2/src_data/ilqr_tvlqr_lqr/experiment06/trajectory.csv",
    "j4.csv": "acrobot/real_hardware_perturbed_v2/src_data/ilqr_tvlqr_lqr/experiment03/trajectory.csv",
    "j5.csv": "acrobot/real_hardware_perturbed_v2/src_data/ilqr_tvlqr_lqr/experiment01/trajectory.csv",
    "j6.csv": "acrobot/real_hardware_perturbed_v2/src_data/ilqr_tvlqr_lqr/experiment05/trajectory.csv",
    "j7.csv": "acrobot/real_hardware_perturbed_v2/src_data/ilqr_tvlqr_lqr/experiment02/trajectory.csv",
    "j8.csv": "acrobot/real_hardware_v2/src_data/ilqr_tvlqr_lqr/experiment07/trajectory.csv",
    "j9.csv": "acrobot/real_hardware_perturbed_v2/src_data/ilqr_tvlqr_lqr/experiment04/trajectory.csv",
    "j10.csv": "acrobot/real_hardware_v2/src_data/ilqr_tvlqr_lqr/experiment05/trajectory.csv",
    "j11.csv": "acrobot/real_hardware_v2/src_data/ilqr_tvlqr_lqr/experiment10/trajectory.csv",
    "j12.csv": "acrobot/real_hardware_perturbed_v2/src_data/ilqr_tvlqr_lqr/experiment06/trajectory.csv",
}
OUT.mkdir(exist_ok=True)
for name, file in RECORDINGS.items():
    with (DATA / file).open() as f:
        names = f.readline().strip().split(",")
    rows = np.genfromtxt(DATA / file, delimiter=",", skip_header=1)
    column = dict(zip(names, rows.T, strict=False))
    t = column["time"] - column["time"][0]
    even = np.arange(0, t[-1], 1 / RATE_HZ)  # the steps of the original are nearly even
    table = [column[f"pos_meas{JOINT}"], -column[f"tau_meas{JOINT}"], column[f"pos_meas{3 - JOINT}"]]
    table = [np.interp(even, t, x) for x in table]
    if EVERY > 1:
        table = [resample_poly(x, 1, EVERY, padtype="line") for x in table]
    time = np.arange(len(table[0])) * EVERY / RATE_HZ
    np.savetxt(
        OUT / name,
        np.c_[time, np.c_[tuple(table)]],
        fmt=["%.4f", "%.5f", "%.4f", "%.4f"],
        delimiter=",",
        header="t_s,angle_rad,torque_Nm,other_angle_rad",
        comments="",
    )
