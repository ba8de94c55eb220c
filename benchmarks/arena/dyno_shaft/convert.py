"""Makes recordings/ from a checkout of github.com/karthikurs/actuator-dynamometer: python convert.py FOLDER."""

import sys
from pathlib import Path

import numpy as np
from scipy.signal import filtfilt, firwin

DATA = Path(sys.argv[1]) / "futek_data"
OUT = Path(__file__).parent / "recordings"
LENGTH_S = 5
# file, first second
RECORDINGS = {
    "h1.csv": ("futek_test_06_05_2021_14-11-02.csv", 1),
    "h2.csv": ("futek_test_06_05_2021_14-11-02.csv", 6),
    "h3.csv": ("futek_test_06_05_2021_14-11-02.csv", 16),
    "h4.csv": ("futek_test_06_05_2021_14-11-02.csv", 41),
    "h5.csv": ("futek_test_06_05_2021_14-11-02.csv", 46),
    "j1.csv": ("futek_test_06_05_2021_14-11-02.csv", 31),
    "j2.csv": ("futek_test_06_05_2021_14-29-55.csv", 46),
    "j3.csv": ("futek_test_06_05_2021_14-21-05.csv", 11),
    "j4.csv": ("futek_test_06_05_2021_14-21-05.csv", 51),
    "j5.csv": ("futek_test_06_05_2021_14-21-05.csv", 6),
    "j6.csv": ("futek_test_06_05_2021_14-07-32.csv", 26),
    "j7.csv": ("futek_test_06_05_2021_14-11-02.csv", 26),
    "j8.csv": ("futek_test_06_05_2021_14-07-32.csv", 51),
    "j9.csv": ("futek_test_06_05_2021_14-21-05.csv", 16),
    "j10.csv": ("futek_test_06_05_2021_14-21-05.csv", 36),
    "j11.csv": ("futek_test_06_05_2021_14-11-02.csv", 21),
    "j12.csv": ("futek_test_06_05_2021_14-23-18.csv", 26),
    "j13.csv": ("futek_test_06_05_2021_14-11-02.csv", 36),
    "j14.csv": ("futek_test_06_05_2021_14-21-05.csv", 41),
    "j15.csv": ("futek_test_06_05_2021_14-11-02.csv", 51),
    "j16.csv": ("futek_test_06_05_2021_14-28-13.csv", 16),
    "j17.csv": ("futek_test_06_05_2021_14-07-32.csv", 46),
    "j18.csv": ("futek_test_06_05_2021_14-29-55.csv", 11),
    "j19.csv": ("futek_test_06_05_2021_14-23-18.csv", 16),
    "j20.csv": ("futek_test_06_05_2021_14-21-05.csv", 46),
    "j21.csv": ("futek_test_06_05_2021_14-28-13.csv", 36),
    "j22.csv": ("futek_test_06_05_2021_14-11-02.csv", 11),
}
LOWPASS = firwin(401, 12, fs=1000)  # rows come every 4 ms or 10 ms, seldom every 18 ms
OUT.mkdir(exist_ok=True)
for name, (file, first_s) in RECORDINGS.items():
    header, *lines = (line.split(",") for line in (DATA / file).read_text().splitlines() if not line.startswith("#"))
    column = dict(zip(header, np.array([line for line in lines if len(line) == len(header)], dtype=float).T, strict=True))
    t_s = column["time [s]"]
    fine_s = np.arange(t_s[0], t_s[-1], 0.001)
    smooth = [filtfilt(LOWPASS, 1, np.interp(fine_s, t_s, column[which])) for which in ("a1 position [rad]", "trs605-5 torque [Nm]")]
    even_s = first_s + np.arange(LENGTH_S * 100) * 0.01
    angle_rad, torque_Nm = (np.interp(even_s, fine_s, values) for values in smooth)
    table = np.c_[even_s - first_s, angle_rad - angle_rad[0], -torque_Nm]
    np.savetxt(OUT / name, table, fmt=["%.2f", "%.4f", "%.5f"], delimiter=",", header="t_s,angle_rad,torque_Nm", comments="")
