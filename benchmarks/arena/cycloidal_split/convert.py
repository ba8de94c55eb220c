"""Makes recordings/ from a checkout of github.com/JelmerV/Anti-Backlash-Cycloidal-Actuator.

`python -m benchmarks.arena.cycloidal_split.convert FOLDER`; later commits of the source have no `Code/test_data`.
"""

from benchmarks.arena.converters import folders, torque_ramp

RECORDINGS = {
    "h1.csv": ("2024-07-17__13-57-05__torqueramp__split 1pre1.csv", 5, 25),
    "h2.csv": ("2024-07-17__13-57-05__torqueramp__split 1pre1.csv", 25, 45),
    "h3.csv": ("2024-07-17__14-07-11__torqueramp__split 1pre5.csv", 45, 60),
    "h4.csv": ("2024-07-17__14-12-54__torqueramp__split 1pre6.csv", 5, 25),
    "h5.csv": ("2024-07-17__14-12-54__torqueramp__split 1pre6.csv", 45, 60),
    "j1.csv": ("2024-07-17__14-30-20__torqueramp__split 2pre5.csv", 5, 25),
    "j2.csv": ("2024-07-17__14-55-39__torqueramp__split 3pre1.csv", 25, 45),
    "j3.csv": ("2024-07-17__14-07-11__torqueramp__split 1pre5.csv", 25, 45),
    "j4.csv": ("2024-07-17__15-14-30__torqueramp__split 3pre6.csv", 45, 60),
    "j5.csv": ("2024-07-17__13-32-02__torqueramp__split reas1.csv", 45, 60),
    "j6.csv": ("2024-07-17__15-04-06__torqueramp__split 3pre5.csv", 25, 45),
    "j7.csv": ("2024-07-17__14-35-53__torqueramp__2pre6.csv", 25, 45),
    "j8.csv": ("2024-07-17__14-35-53__torqueramp__2pre6.csv", 5, 25),
    "j9.csv": ("2024-07-17__14-07-11__torqueramp__split 1pre5.csv", 5, 25),
    "j10.csv": ("2024-07-17__13-41-31__torqueramp__split reas6.csv", 5, 25),
    "j11.csv": ("2024-07-17__13-36-10__torqueramp__split reas5.csv", 45, 60),
    "j12.csv": ("2024-07-17__15-04-06__torqueramp__split 3pre5.csv", 45, 60),
    "j13.csv": ("2024-07-17__14-25-16__torqueramp__split 2pre1.csv", 5, 25),
    "j14.csv": ("2024-07-17__13-32-02__torqueramp__split reas1.csv", 5, 25),
    "j15.csv": ("2024-07-17__14-12-54__torqueramp__split 1pre6.csv", 25, 45),
    "j16.csv": ("2024-07-17__14-55-39__torqueramp__split 3pre1.csv", 5, 25),
    "j17.csv": ("2024-07-17__14-25-16__torqueramp__split 2pre1.csv", 25, 45),
    "j18.csv": ("2024-07-17__13-57-05__torqueramp__split 1pre1.csv", 45, 60),
}

if __name__ == "__main__":
    torque_ramp(*folders(__file__), RECORDINGS)
