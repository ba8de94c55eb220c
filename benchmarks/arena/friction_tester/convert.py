"""Makes recordings/ from a checkout of github.com/jchristopherson/FrictionModels.jl: python convert.py FOLDER."""

import sys
from pathlib import Path

import numpy as np
from scipy.signal import resample_poly

OUT = Path(__file__).parent / "recordings"
ZERO_MM = -110.0355  # position of the first row
# first and last second of the run
RECORDINGS = {
    "h1.csv": (12, 32),
    "h2.csv": (72, 92),
    "h3.csv": (152, 172),
    "j1.csv": (172, 192),
    "j2.csv": (132, 152),
    "j3.csv": (32, 52),
    "j4.csv": (92, 112),
    "j5.csv": (112, 132),
    "j6.csv": (52, 72),
}
t, normal, position, friction = np.genfromtxt(Path(sys.argv[1]) / "examples" / "test_data_2.txt", skip_header=1).T
OUT.mkdir(exist_ok=True)
for name, (first, last) in RECORDINGS.items():
    part = (t >= first) & (t < last)
    z = resample_poly((position[part] - ZERO_MM) / 1000, 1, 2, padtype="line")
    force = resample_poly(friction[part] / 1e6, 1, 2, padtype="line")
    time = np.arange(len(z)) * 0.01
    np.savetxt(OUT / name, np.c_[time, z, force], fmt=["%.2f", "%.8f", "%.5f"], delimiter=",", header="t_s,z_m,fz_N", comments="")
