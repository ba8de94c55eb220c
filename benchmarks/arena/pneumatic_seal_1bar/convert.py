"""Makes recordings/ from a checkout of github.com/EvaZillen/3D-printed-pneumatic-actuator: python convert.py FOLDER."""

import sys
from pathlib import Path

import numpy as np

DATA = Path(sys.argv[1]) / "results_pneumatic-actuator" / "data"
OUT = Path(__file__).parent / "recordings"
PRESSURE_BAR = 1
# file, bore in mm, first stroke, number of strokes
RECORDINGS = {
    "h1.csv": ("repeatability/reconnected/friction/1_O-ring257_1bar.csv", 25.7, 0, 3),
    "h2.csv": ("repeatability/rerun/friction/1_O-ring257_1bar.csv", 25.7, 0, 3),
    "h3.csv": ("repeatability/rerun/friction/1_O-ring257_1bar.csv", 25.7, 3, 3),
    "h4.csv": ("repeatability/rerun/friction/1_O-ring257_1bar.csv", 25.7, 6, 4),
    "h5.csv": ("repeatability/rerun/friction/2_O-ring257_1bar.csv", 25.7, 3, 3),
    "h6.csv": ("repeatability/reconnected/friction/3_O-ring257_1bar.csv", 25.7, 3, 3),
    "j1.csv": ("friction/PK_1bar.csv", 25.0, 3, 3),
    "j2.csv": ("repeatability/reconnected/friction/3_O-ring257_1bar.csv", 25.7, 0, 3),
    "j3.csv": ("repeatability/rerun/friction/2_O-ring257_1bar.csv", 25.7, 0, 3),
    "j4.csv": ("repeatability/reconnected/friction/1_O-ring257_1bar.csv", 25.7, 6, 4),
    "j5.csv": ("repeatability/rerun/friction/2_O-ring257_1bar.csv", 25.7, 6, 4),
    "j6.csv": ("friction/NAP310_1bar.csv", 25.0, 3, 3),
    "j7.csv": ("repeatability/rerun/friction/3_O-ring257_1bar.csv", 25.7, 3, 3),
    "j8.csv": ("repeatability/reconnected/friction/1_O-ring257_1bar.csv", 25.7, 3, 3),
    "j9.csv": ("friction/NAP310_1bar.csv", 25.0, 0, 3),
    "j10.csv": ("friction/PK_1bar.csv", 25.0, 6, 4),
    "j11.csv": ("repeatability/rerun/friction/3_O-ring257_1bar.csv", 25.7, 6, 4),
    "j12.csv": ("repeatability/rerun/friction/3_O-ring257_1bar.csv", 25.7, 0, 3),
    "j13.csv": ("repeatability/reconnected/friction/3_O-ring257_1bar.csv", 25.7, 6, 4),
    "j14.csv": ("friction/PK_1bar.csv", 25.0, 0, 3),
    "j15.csv": ("friction/NAP310_1bar.csv", 25.0, 6, 4),
}


def read(file):
    """Time in s, laser in mm, force in N, of one file; the makers drop the first 15 rows too."""
    t, _, _, _, laser, _, force = np.loadtxt(DATA / file)[15:].T
    t = (t - t[0]) / 1000 if t[-1] > 1000 else t - t[0]  # some files hold ms, others s
    even = np.arange(0, t[-1], 0.01)  # a few gaps of up to 0.3 s are bridged
    return even, np.interp(even, t, laser), np.interp(even, t, force)


def strokes(laser):
    """Rows at which a stroke begins: where the laser falls through its lower fifth."""
    low = laser.min() + 0.2 * (laser.max() - laser.min())
    rows = np.flatnonzero((laser[:-1] >= low) & (laser[1:] < low))
    return np.r_[0, rows[np.r_[True, np.diff(rows) > 100]]]


OUT.mkdir(exist_ok=True)
for name, (file, bore, first, number) in RECORDINGS.items():
    t, laser, force = read(file)
    cut = strokes(laser)
    part = slice(cut[first], cut[min(first + number, len(cut) - 1)])
    tare = PRESSURE_BAR * 1e5 * np.pi * (bore / 2000) ** 2
    table = np.c_[np.arange(part.stop - part.start) * 0.01, -laser[part] / 1000, force[part] - tare]
    np.savetxt(OUT / name, table, fmt=["%.2f", "%.6f", "%.2f"], delimiter=",", header="t_s,z_m,fz_N", comments="")
