"""Makes recordings/ from a checkout of github.com/EvaZillen/3D-printed-pneumatic-actuator.

`python -m benchmarks.arena.pneumatic_seal_1bar.convert FOLDER`
"""

from benchmarks.arena.converters import folders, pneumatic_seal

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

if __name__ == "__main__":
    pneumatic_seal(*folders(__file__), RECORDINGS, pressure_bar=1)
