"""Makes recordings/ from a checkout of github.com/BuddyOG/topre-force-curves: python convert.py FOLDER."""

import sys
from pathlib import Path

import numpy as np

OUT = Path(__file__).parent / "recordings"
LAST_MM = 3.6  # the end stop of the key begins below
N_PER_GF = 9.80665e-3
RECORDINGS = {
    "h1.csv": "Topre_R1_45g/DataLog_1.csv",
    "h2.csv": "Topre_R1_45g/DataLog_2.csv",
    "h3.csv": "Topre_R1_45g/DataLog_4.csv",
    "h4.csv": "Topre_RGB_45g/DataLog_1.csv",
    "h5.csv": "Topre_GX1_45g/DataLog_2.csv",
    "j1.csv": "Topre_GX1_45g/DataLog_1.csv",
    "j2.csv": "Topre_R1_55g/DataLog_2.csv",
    "j3.csv": "DynaCaps_Light_35g/DataLog_3.csv",
    "j4.csv": "DynaCaps_Light_35g/DataLog_1.csv",
    "j5.csv": "KLC_Densus_55g/DataLog_1.csv",
    "j6.csv": "Topre_R1_30g/DataLog_1.csv",
    "j7.csv": "Dynacaps_Heavy_55g/DynaCaps_Heavy-DataLog_3.csv",
    "j8.csv": "Topre_R1_45g/DataLog_3.csv",
    "j9.csv": "Topre_R2_30g/DataLog_1.csv",
    "j10.csv": "Dynacaps_Heavy_55g/DynaCaps_Heavy-DataLog_2.csv",
    "j11.csv": "Topre_RGB_45g/DataLog_2.csv",
    "j12.csv": "KLC_Densus_55g/DataLog_2.csv",
    "j13.csv": "Topre_R1_55g/DataLog_1.csv",
    "j14.csv": "Topre_R2_30g/DataLog_2.csv",
    "j15.csv": "Topre_R1_30g/DataLog_3.csv",
}
OUT.mkdir(exist_ok=True)
for name, file in RECORDINGS.items():
    t_ms, _, travel_mm, _, force_gf = np.genfromtxt(Path(sys.argv[1]) / file, delimiter=",", skip_header=1).T
    last = np.argmax(travel_mm >= LAST_MM)
    t_s = (t_ms[: last + 1] - t_ms[0]) / 1000
    even_s = np.arange(0, t_s[-1], 1 / 30)  # the steps are 33 ms or 34 ms, and now and then up to 0.2 s
    table = [0.0 - np.interp(even_s, t_s, travel_mm[: last + 1]) / 1000, np.interp(even_s, t_s, force_gf[: last + 1]) * N_PER_GF]
    np.savetxt(OUT / name, np.c_[even_s, *table], fmt=["%.6f", "%.8f", "%.6f"], delimiter=",", header="t_s,z_m,fz_N", comments="")
