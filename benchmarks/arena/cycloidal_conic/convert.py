"""Makes recordings/ from a checkout of github.com/JelmerV/Anti-Backlash-Cycloidal-Actuator.

`python -m benchmarks.arena.cycloidal_conic.convert FOLDER`; later commits of the source have no `Code/test_data`.
"""

from benchmarks.arena.converters import folders, torque_ramp

RECORDINGS = {
    "h1.csv": ("2024-07-12__14-52-50__torqueramp__conic 2pre1.csv", 5, 25),
    "h2.csv": ("2024-07-12__14-52-50__torqueramp__conic 2pre1.csv", 25, 45),
    "h3.csv": ("2024-07-12__14-57-29__torqueramp__conic 2pre5.csv", 45, 60),
    "h4.csv": ("2024-07-12__15-12-22__torqueramp__conic 2pre6.csv", 5, 25),
    "h5.csv": ("2024-07-12__15-12-22__torqueramp__conic 2pre6.csv", 45, 60),
    "j1.csv": ("2024-07-12__16-28-44__torqueramp__conic 3pre6.csv", 5, 25),
    "j2.csv": ("2024-07-12__14-57-29__torqueramp__conic 2pre5.csv", 25, 45),
    "j3.csv": ("2024-07-12__14-31-48__torqueramp__conic 1pre6.csv", 45, 60),
    "j4.csv": ("2024-07-12__14-26-23__torqueramp__conic 1pre5.csv", 5, 25),
    "j5.csv": ("2024-07-12__16-51-38__torqueramp__conic 4pre6.csv", 25, 45),
    "j6.csv": ("2024-07-12__16-23-23__torqueramp__conic 3pre1.csv", 25, 45),
    "j7.csv": ("2024-07-12__14-57-29__torqueramp__conic 2pre5.csv", 5, 25),
    "j8.csv": ("2024-07-12__17-09-01__torqueramp__conic 5pre1.csv", 45, 60),
    "j9.csv": ("2024-07-12__16-57-04__torqueramp__conic 4pre5.csv", 25, 45),
    "j10.csv": ("2024-07-12__15-12-22__torqueramp__conic 2pre6.csv", 25, 45),
    "j11.csv": ("2024-07-12__13-16-01__torqueramp__conic runin5.csv", 45, 60),
    "j12.csv": ("2024-07-12__16-46-43__torqueramp__conic 4pre1.csv", 45, 60),
    "j13.csv": ("2024-07-12__17-13-06__torqueramp__conic 5pre6.csv", 45, 60),
    "j14.csv": ("2024-07-12__17-17-36__torqueramp__conic 5pre5.csv", 25, 45),
    "j15.csv": ("2024-07-12__14-07-48__torqueramp__conic 1pre1.csv", 25, 45),
    "j16.csv": ("2024-07-12__16-34-37__torqueramp__conic 3pre5.csv", 5, 25),
    "j17.csv": ("2024-07-12__13-05-47__torqueramp__conic runin1.csv", 25, 45),
    "j18.csv": ("2024-07-12__14-52-50__torqueramp__conic 2pre1.csv", 45, 60),
    "j19.csv": ("2024-07-12__13-32-22__torqueramp__conic runin6.csv", 25, 45),
}

if __name__ == "__main__":
    torque_ramp(*folders(__file__), RECORDINGS)
