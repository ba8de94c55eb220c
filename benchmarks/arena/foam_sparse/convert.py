"""Makes recordings/ from a checkout of github.com/TransformativeRoboticsLab/FDE-Metamaterials: python convert.py FOLDER."""

import csv
import sys
from pathlib import Path

import numpy as np
from scipy.signal import resample_poly

OUT = Path(__file__).parent / "recordings"
TESTS = "data/instron_tests/homogeneous_foams/250309/250309_Homogeneous_Foam_{0}.is_comp_Exports/250309_Homogeneous_Foam_{0}_{1}_1.csv"
# foam and number of the test: 1 to 3 press along Z, 4 to 6 along Y, 7 to 9 along X
RECORDINGS = {
    "h1.csv": ("Sparse_v1", 4),
    "h2.csv": ("Sparse_v1", 6),
    "h3.csv": ("Sparse_v1", 8),
    "h4.csv": ("Sparse_v2", 5),
    "h5.csv": ("Sparse_v2", 7),
    "h6.csv": ("Sparse_v2", 9),
    "j1.csv": ("Sparse_v2", 6),
    "j2.csv": ("Sparse_v2", 8),
    "j3.csv": ("Dense_v2", 8),
    "j4.csv": ("Sparse_v1", 2),
    "j5.csv": ("Dense_v2", 1),
    "j6.csv": ("Sparse_v1", 5),
    "j7.csv": ("Sparse_v1", 9),
    "j8.csv": ("Dense_v1", 9),
    "j9.csv": ("Sparse_v2", 1),
    "j10.csv": ("Dense_v2", 5),
    "j11.csv": ("Dense_v1", 2),
    "j12.csv": ("Sparse_v2", 2),
    "j13.csv": ("Sparse_v2", 3),
    "j14.csv": ("Sparse_v1", 3),
    "j15.csv": ("Sparse_v1", 7),
    "j16.csv": ("Sparse_v2", 4),
    "j17.csv": ("Dense_v1", 4),
}
OUT.mkdir(exist_ok=True)
for name, (foam, test) in RECORDINGS.items():
    with (Path(sys.argv[1]) / TESTS.format(foam, test)).open() as file:
        rows = list(csv.reader(file))
    first = next(row for row, cells in enumerate(rows) if cells and cells[0] == "Time") + 2  # names and units stand above
    numbers = np.array([cells[:4] for cells in rows[first:] if len(cells) == 6], dtype=float)[:-1]  # the last step is uneven
    _, _, force_N, compression_mm = numbers.T
    z_m, fz_N = (resample_poly(values, 1, 2, padtype="line") for values in (0.0 - compression_mm / 1000, force_N))
    t_s = np.arange(len(z_m)) * 0.04
    np.savetxt(OUT / name, np.c_[t_s, z_m, fz_N], fmt=["%.2f", "%.8f", "%.4f"], delimiter=",", header="t_s,z_m,fz_N", comments="")
