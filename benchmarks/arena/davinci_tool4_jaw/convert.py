"""Makes recordings/ from a checkout of github.com/MRDLab/mis-tool-characterization: python convert.py FOLDER."""

import sys
from pathlib import Path

import numpy as np
from scipy.signal import resample_poly

DATA = Path(sys.argv[1]) / "data"
OUT = Path(__file__).parent / "recordings"
RAD_PER_COUNT = 2 * np.pi / 8192  # encoder of the back end, README of the source
NM_PER_COUNT = 0.000039811  # torque sensor of the back end, README of the source
# file, first and last period of the sine, frequency in Hz
RECORDINGS = {
    "h1.csv": ("Tool_4_Maryland_L_4/10.TXT", 0, 4, 0.2),
    "h2.csv": ("Tool_4_Maryland_L_4/20.TXT", 0, 3, 0.3),
    "h3.csv": ("Tool_4_Maryland_L_4/40.TXT", 3, 6, 0.5),
    "h4.csv": ("Tool_4_Maryland_L_2/20.TXT", 3, 6, 0.3),
    "h5.csv": ("Tool_4_Maryland_L_2/30.TXT", 0, 4, 0.4),
    "h6.csv": ("Tool_4_Maryland_L_2/40.TXT", 0, 3, 0.5),
    "j1.csv": ("Tool_4_Maryland_L_2/40.TXT", 6, 10, 0.5),
    "j2.csv": ("Tool_4_Maryland_L_2/40.TXT", 3, 6, 0.5),
    "j3.csv": ("Tool_4_Maryland_L_4/23.TXT", 0, 3, 0.3),
    "j4.csv": ("Tool_4_Maryland_L_4/40.TXT", 6, 10, 0.5),
    "j5.csv": ("Tool_4_Maryland_L_4/20.TXT", 3, 6, 0.3),
    "j6.csv": ("Tool_4_Maryland_L_4/49.TXT", 3, 6, 0.5),
    "j7.csv": ("Tool_4_Maryland_L_4/19.TXT", 0, 4, 0.2),
    "j8.csv": ("Tool_4_Maryland_L_4/36.TXT", 0, 4, 0.4),
    "j9.csv": ("Tool_4_Maryland_L_2/43.TXT", 0, 3, 0.5),
    "j10.csv": ("Tool_4_Maryland_L_2/20.TXT", 0, 3, 0.3),
    "j11.csv": ("Tool_4_Maryland_L_4/30.TXT", 4, 8, 0.4),
    "j12.csv": ("Tool_4_Maryland_L_4/30.TXT", 0, 4, 0.4),
    "j13.csv": ("Tool_4_Maryland_L_2/23.TXT", 3, 6, 0.3),
    "j14.csv": ("Tool_4_Maryland_L_2/30.TXT", 4, 8, 0.4),
    "j15.csv": ("Tool_4_Maryland_L_4/40.TXT", 0, 3, 0.5),
    "j16.csv": ("Tool_4_Maryland_L_2/10.TXT", 0, 4, 0.2),
}
OUT.mkdir(exist_ok=True)
for name, (file, first, last, hertz) in RECORDINGS.items():
    rows = []
    for line in (DATA / file).read_text(errors="replace").splitlines():
        if not line.startswith(("%", "B")) and line.count(",") == 9:
            rows.append([float(x) for x in line.split(",")])
    rows = np.array(rows)
    t, motion, torque = rows[:, 0], rows[:, 1] * RAD_PER_COUNT, rows[:, 2] * NM_PER_COUNT
    target = rows[:, 9] * RAD_PER_COUNT
    even = np.arange(0, t[-1], 0.001)  # a few lines of the logs are lost
    table = [resample_poly(np.interp(even, t, x), 1, 10, padtype="line") for x in (motion, torque, target)]
    part = slice(round(first / hertz * 100), round(last / hertz * 100))
    table = np.c_[tuple(x[part] for x in table)]
    time = np.arange(len(table)) * 0.01
    np.savetxt(
        OUT / name,
        np.c_[time, table],
        fmt=["%.2f", "%.5f", "%.5f", "%.5f"],
        delimiter=",",
        header="t_s,angle_rad,torque_Nm,angle_cmd_rad",
        comments="",
    )
