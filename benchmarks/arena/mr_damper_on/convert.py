"""Makes recordings/ from a checkout of github.com/labcontrol-data/mr-damper.

`python -m benchmarks.arena.mr_damper_on.convert FOLDER`
"""

from benchmarks.arena.converters import folders, mr_damper

RECORDINGS = {
    "h1.csv": ("ensaio5.2.2.mat", 0, 15),
    "h2.csv": ("ensaio6.2.2.mat", 0, 15),
    "h3.csv": ("ensaio8.2.2.mat", 0, 15),
    "h4.csv": ("ensaio10.2.2.mat", 0, 15),
    "h5.csv": ("ensaio.vali.2.mat", 0, 15),
    "h6.csv": ("ensaio.vali.4.mat", 0, 15),
    "h7.csv": ("ensaio.vali.7.mat", 0, 15),
    "j1.csv": ("ensaio.vali.1.mat", 0, 15),
    "j2.csv": ("ensaio9.2.2.mat", 0, 15),
    "j3.csv": ("ensaio.vali.8.mat", 0, 15),
    "j4.csv": ("ensaio8.1.mat", 5, 20),
    "j5.csv": ("ensaio4.2.2.mat", 0, 15),
    "j6.csv": ("ensaio.vali.6.mat", 0, 15),
    "j7.csv": ("ensaio.vali.3.mat", 0, 15),
    "j8.csv": ("ensaio2.1.mat", 5, 20),
    "j9.csv": ("ensaio7.2.2.mat", 0, 15),
    "j10.csv": ("ensaio.vali.9.mat", 0, 15),
    "j11.csv": ("ensaio.vali.5.mat", 0, 15),
    "j12.csv": ("ensaio.B.9.mat", 0, 15),
    "j13.csv": ("ensaio.B.6.mat", 0, 15),
    "j14.csv": ("ensaio.B.1.mat", 0, 15),
    "j15.csv": ("ensaio5.1.mat", 5, 20),
}

if __name__ == "__main__":
    mr_damper(*folders(__file__), RECORDINGS)
