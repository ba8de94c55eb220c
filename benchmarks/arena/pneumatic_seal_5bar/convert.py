"""Makes recordings/ from a checkout of github.com/EvaZillen/3D-printed-pneumatic-actuator.

`python -m benchmarks.arena.pneumatic_seal_5bar.convert FOLDER`
"""

from benchmarks.arena.converters import folders, pneumatic_seal

RECORDINGS = {
    "h1.csv": ("repeatability/reconnected/friction/1_O-ring257_5bar.csv", 25.7, 0, 3),
    "h2.csv": ("repeatability/rerun/friction/1_O-ring257_5bar.csv", 25.7, 0, 3),
    "h3.csv": ("repeatability/rerun/friction/1_O-ring257_5bar.csv", 25.7, 3, 3),
    "h4.csv": ("repeatability/rerun/friction/1_O-ring257_5bar.csv", 25.7, 6, 4),
    "h5.csv": ("repeatability/rerun/friction/2_O-ring257_5bar.csv", 25.7, 3, 3),
    "h6.csv": ("repeatability/reconnected/friction/3_O-ring257_5bar.csv", 25.7, 3, 3),
    "j1.csv": ("repeatability/rerun/friction/3_O-ring257_5bar.csv", 25.7, 3, 3),
    "j2.csv": ("repeatability/reconnected/friction/1_O-ring257_5bar.csv", 25.7, 3, 3),
    "j3.csv": ("repeatability/rerun/friction/3_O-ring257_5bar.csv", 25.7, 0, 3),
    "j4.csv": ("repeatability/reconnected/friction/3_O-ring257_5bar.csv", 25.7, 6, 4),
    "j5.csv": ("repeatability/rerun/friction/2_O-ring257_5bar.csv", 25.7, 0, 3),
    "j6.csv": ("repeatability/reconnected/friction/1_O-ring257_5bar.csv", 25.7, 6, 4),
    "j7.csv": ("repeatability/rerun/friction/3_O-ring257_5bar.csv", 25.7, 6, 4),
    "j8.csv": ("repeatability/reconnected/friction/3_O-ring257_5bar.csv", 25.7, 0, 3),
    "j9.csv": ("repeatability/rerun/friction/2_O-ring257_5bar.csv", 25.7, 6, 4),
}

if __name__ == "__main__":
    pneumatic_seal(*folders(__file__), RECORDINGS, pressure_bar=5)
