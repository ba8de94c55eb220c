"""Makes recordings/ from a checkout of github.com/labcontrol-data/mr-damper.

`python -m benchmarks.arena.mr_damper_off.convert FOLDER`
"""

from benchmarks.arena.converters import folders, mr_damper

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

if __name__ == "__main__":
    mr_damper(*folders(__file__), RECORDINGS)
