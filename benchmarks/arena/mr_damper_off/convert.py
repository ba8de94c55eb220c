"""Makes recordings/ from a checkout of github.com/labcontrol-data/mr-damper: python convert.py FOLDER."""

import sys
from pathlib import Path

import numpy as np
from scipy.io import loadmat

DATA = Path(sys.argv[1]) / "data"
OUT = Path(__file__).parent / "recordings"
TARE_N = 132.0  # mean of both directions without current; the same for all recordings
# file, first and last second
RECORDINGS = {
    "h1.csv": ("ensaio1.1.mat", 0, 10),
    "h2.csv": ("ensaio2.1.mat", 10, 20),
    "h3.csv": ("ensaio4.1.mat", 0, 10),
    "h4.csv": ("ensaio6.1.mat", 20, 30),
    "h5.csv": ("ensaio8.1.mat", 10, 20),
    "h6.csv": ("ensaio10.1.mat", 0, 10),
    "j1.csv": ("ensaio9.1.mat", 20, 30),
    "j2.csv": ("ensaio2.1.mat", 20, 30),
    "j3.csv": ("ensaio.B.7.mat", 0, 15),
    "j4.csv": ("ensaio.B.3.mat", 0, 15),
    "j5.csv": ("ensaio4.1.mat", 20, 30),
    "j6.csv": ("ensaio5.1.mat", 20, 30),
    "j7.csv": ("ensaio3.1.mat", 0, 10),
    "j8.csv": ("ensaio6.1.mat", 0, 10),
    "j9.csv": ("ensaio9.1.mat", 0, 10),
    "j10.csv": ("ensaio9.2.2.mat", 0, 15),
    "j11.csv": ("ensaio.A.6.mat", 0, 15),
    "j12.csv": ("ensaio.A.2.mat", 0, 15),
    "j13.csv": ("ensaio7.2.2.mat", 0, 15),
    "j14.csv": ("ensaio5.1.mat", 0, 10),
    "j15.csv": ("ensaio3.1.mat", 20, 30),
    "j16.csv": ("ensaio1.1.mat", 20, 30),
    "j17.csv": ("ensaio8.1.mat", 20, 30),
    "j18.csv": ("ensaio7.1.mat", 10, 20),
    "j19.csv": ("ensaio6.2.2.mat", 0, 15),
}
OUT.mkdir(exist_ok=True)
for name, (file, first, last) in RECORDINGS.items():
    data = loadmat(DATA / file)
    step = data["Ts"].item()
    part = slice(round(first / step), round(last / step))
    z, force = -data["dist"].ravel()[part] / 1000, data["forc"].ravel()[part] - TARE_N
    time = np.arange(len(z)) * step
    np.savetxt(OUT / name, np.c_[time, z, force], fmt=["%.2f", "%.6f", "%.2f"], delimiter=",", header="t_s,z_m,fz_N", comments="")
