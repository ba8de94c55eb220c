"""Makes recordings/ from a checkout of github.com/nikolaiwest/2023-anomaly-detection-hicss: python convert.py FOLDER."""

import json
import sys
from pathlib import Path

import numpy as np
from scipy.signal import resample_poly

DATA = Path(sys.argv[1]) / "data"
OUT = Path(__file__).parent / "recordings"
STEP_S = 0.0012
LAST_DEGREES = 1450  # before the station slows down and the head of the screw touches
RECORDINGS = {
    "h1.csv": "Ch_000001596588.json",
    "h2.csv": "Ch_000001597634.json",
    "h3.csv": "Ch_000001599620.json",
    "h4.csv": "Ch_000001600572.json",
    "h5.csv": "Ch_000001601284.json",
    "h6.csv": "Ch_000001602342.json",
    "j1.csv": "Ch_000001601008.json",
    "j2.csv": "Ch_000001600970.json",
    "j3.csv": "Ch_000001598340.json",
    "j4.csv": "Ch_000001602520.json",
    "j5.csv": "Ch_000001601390.json",
    "j6.csv": "Ch_000001597040.json",
    "j7.csv": "Ch_000001601998.json",
    "j8.csv": "Ch_000001596500.json",
    "j9.csv": "Ch_000001597090.json",
    "j10.csv": "Ch_000001601298.json",
    "j11.csv": "Ch_000001601784.json",
    "j12.csv": "Ch_000001596778.json",
    "j13.csv": "Ch_000001601384.json",
    "j14.csv": "Ch_000001601066.json",
    "j15.csv": "Ch_000001597188.json",
    "j16.csv": "Ch_000001600674.json",
    "j17.csv": "Ch_000001601726.json",
    "j18.csv": "Ch_000001602540.json",
    "j19.csv": "Ch_000001596568.json",
    "j20.csv": "Ch_000001602340.json",
}
OUT.mkdir(exist_ok=True)
for name, file in RECORDINGS.items():
    graphs = [step["graph"] for step in json.loads((DATA / file).read_text())["tightening steps"][:2]]
    t, angle, torque = (np.concatenate([graph[f"{which} values"] for graph in graphs]) for which in ("time", "angle", "torque"))
    t, rows = np.unique(t, return_index=True)  # the last row of a step is the first one of the next
    angle, torque = angle[rows], torque[rows]
    even = np.arange(t[0], t[np.flatnonzero(angle <= LAST_DEGREES)[-1]], STEP_S)  # a few rows are lost
    table = [resample_poly(np.interp(even, t, values), 1, 2, padtype="line") for values in (np.deg2rad(angle), -torque)]
    time = np.arange(len(table[0])) * 2 * STEP_S
    np.savetxt(OUT / name, np.c_[time, *table], fmt=["%.4f", "%.4f", "%.4f"], delimiter=",", header="t_s,angle_rad,torque_Nm", comments="")
