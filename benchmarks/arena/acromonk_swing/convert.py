"""Makes recordings/ from a checkout of github.com/dfki-ric-underactuated-lab/acromonk: python convert.py FOLDER."""

import sys
from pathlib import Path

import numpy as np

DATA = Path(sys.argv[1]) / "results" / "real_system" / "csvs"
OUT = Path(__file__).parent / "recordings"
RATE_HZ = 200
# file, first and last second
RECORDINGS = {
    "h1.csv": ("BF_pd_5x.csv", 0.02, 2.22),
    "h2.csv": ("BF_pd_5x.csv", 2.27, 4.47),
    "h3.csv": ("BF_tvlqr_5x.csv", 0.02, 2.35),
    "h4.csv": ("BF_tvlqr_5x.csv", 2.57, 4.89),
    "h5.csv": ("BF_rl_5x.csv", 0.02, 2.8),
    "h6.csv": ("BF_rl_5x.csv", 3.02, 5.82),
    "j1.csv": ("BF_tvlqr_5x.csv", 10.26, 12.58),
    "j2.csv": ("BF_pd_5x.csv", 6.77, 8.97),
    "j3.csv": ("BF_rl_5x.csv", 9.06, 11.89),
    "j4.csv": ("BF_rl_5x.csv", 12.11, 15.3),
    "j5.csv": ("BF_tvlqr_5x.csv", 5.11, 7.45),
    "j6.csv": ("BF_tvlqr_5x.csv", 7.67, 10.03),
    "j7.csv": ("BF_rl_5x.csv", 6.05, 8.84),
    "j8.csv": ("BF_pd_5x.csv", 9.08, 11.28),
    "j9.csv": ("BF_pd_5x.csv", 4.52, 6.72),
}
OUT.mkdir(exist_ok=True)
for name, (file, first, last) in RECORDINGS.items():
    with (DATA / file).open() as f:
        names = f.readline().strip().split(",")
    column = dict(zip(names, np.genfromtxt(DATA / file, delimiter=",", skip_header=1).T, strict=False))
    even = np.arange(first, last, 1 / RATE_HZ)
    motion, torque, shoulder = (
        np.interp(even, column["meas_time"], column[x]) for x in ("elbow_meas_pos", "elbow_meas_tau", "shoulder_meas_pos")
    )
    np.savetxt(
        OUT / name,
        np.c_[even - even[0], motion, -torque, shoulder],
        fmt=["%.3f", "%.5f", "%.4f", "%.4f"],
        delimiter=",",
        header="t_s,angle_rad,torque_Nm,other_angle_rad",
        comments="",
    )
