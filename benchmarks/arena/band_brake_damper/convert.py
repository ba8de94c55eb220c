"""Makes recordings/ from a checkout of github.com/ARTS-Laboratory/Dataset-Friction-Damper-with-Backlash: python convert.py FOLDER."""

import json
import sys
from pathlib import Path

import numpy as np
from scipy.signal import resample_poly

OUT = Path(__file__).parent / "recordings"
M_PER_INCH = 0.0254
N_PER_KIP = 4448.2216
EVERY = 8  # 1024 Hz become 128 Hz
PARTS_S = {"0.25": (4, 20), "0.5": (2, 12), "1": (1, 6)}  # by frequency: full periods; the first and the last ones begin and end at rest
TESTS = {2: "characterization datasets", 3: "characterization tests"}
# dataset, frequency in Hz, stated tension of the bands in lb, amplitude in inches
RECORDINGS = {
    "h1.csv": (2, "0.25", 30, "1"),
    "h2.csv": (3, "0.25", 30, "1.5"),
    "h3.csv": (2, "0.5", 30, "0.5"),
    "h4.csv": (3, "0.5", 30, "1"),
    "h5.csv": (2, "1", 30, "1.5"),
    "h6.csv": (3, "1", 30, "0.5"),
    "j1.csv": (3, "1", 30, "1.5"),
    "j2.csv": (2, "0.25", 36, "1.5"),
    "j3.csv": (2, "1", 36, "0.5"),
    "j4.csv": (2, "0.5", 36, "1.5"),
    "j5.csv": (2, "0.5", 36, "1"),
    "j6.csv": (2, "1", 36, "1.5"),
    "j7.csv": (2, "1", 0, "1"),
    "j8.csv": (3, "0.25", 30, "1"),
    "j9.csv": (2, "0.5", 30, "1.5"),
    "j10.csv": (2, "0.25", 30, "0.5"),
    "j11.csv": (2, "1", 30, "1"),
    "j12.csv": (2, "0.25", 36, "0.5"),
    "j13.csv": (2, "0.25", 0, "1.5"),
    "j14.csv": (2, "1", 0, "1.5"),
    "j15.csv": (2, "1", 30, "0.5"),
    "j16.csv": (2, "0.5", 0, "1.5"),
    "j17.csv": (3, "0.5", 30, "0.5"),
    "j18.csv": (3, "0.5", 30, "1.5"),
    "j19.csv": (2, "0.5", 0, "1"),
    "j20.csv": (2, "0.25", 30, "1.5"),
    "j21.csv": (2, "0.25", 36, "1"),
    "j22.csv": (3, "1", 30, "1"),
    "j23.csv": (2, "0.5", 30, "1"),
    "j24.csv": (2, "0.5", 36, "0.5"),
    "j25.csv": (2, "1", 36, "1"),
    "j26.csv": (3, "0.25", 30, "0.5"),
}
OUT.mkdir(exist_ok=True)
for name, (dataset, frequency, tension, amplitude) in RECORDINGS.items():
    file = Path(sys.argv[1]) / "data" / f"dataset-{dataset}" / TESTS[dataset] / f"{frequency}Hz{tension}lbtension{amplitude}amplitude.json"
    _, displacement, friction, *_ = np.array(json.loads(file.read_text())["data"]).T
    part = slice(*(second * 1024 // EVERY for second in PARTS_S[frequency]))
    z, force = (resample_poly(values, 1, EVERY, padtype="line")[part] for values in (-displacement * M_PER_INCH, friction * N_PER_KIP))
    time = np.arange(len(z)) * EVERY / 1024
    np.savetxt(OUT / name, np.c_[time, z, force], fmt=["%.5f", "%.6f", "%.1f"], delimiter=",", header="t_s,z_m,fz_N", comments="")
