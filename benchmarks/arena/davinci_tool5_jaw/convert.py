"""Makes recordings/ from a checkout of github.com/MRDLab/mis-tool-characterization.

`python -m benchmarks.arena.davinci_tool5_jaw.convert FOLDER`
"""

from benchmarks.arena.converters import davinci_tool, folders

RECORDINGS = {
    "h1.csv": ("Tool_5_Maryland_L_3/10.TXT", 0, 4, 0.2),
    "h2.csv": ("Tool_5_Maryland_L_3/20.TXT", 0, 3, 0.3),
    "h3.csv": ("Tool_5_Maryland_L_3/40.TXT", 3, 6, 0.5),
    "h4.csv": ("Tool_5_Maryland_L_2/20.TXT", 3, 6, 0.3),
    "h5.csv": ("Tool_5_Maryland_L_2/30.TXT", 0, 4, 0.4),
    "h6.csv": ("Tool_5_Maryland_L_2/40.TXT", 0, 3, 0.5),
    "j1.csv": ("Tool_5_Maryland_L_2/40.TXT", 3, 6, 0.5),
    "j2.csv": ("Tool_5_Maryland_L_3/20.TXT", 3, 6, 0.3),
    "j3.csv": ("Tool_5_Maryland_L_2/10.TXT", 0, 4, 0.2),
    "j4.csv": ("Tool_5_Maryland_L_2/23.TXT", 3, 6, 0.3),
    "j5.csv": ("Tool_5_Maryland_L_3/49.TXT", 3, 6, 0.5),
    "j6.csv": ("Tool_5_Maryland_L_3/29.TXT", 0, 3, 0.3),
    "j7.csv": ("Tool_5_Maryland_L_3/30.TXT", 4, 8, 0.4),
    "j8.csv": ("Tool_5_Maryland_L_3/40.TXT", 0, 3, 0.5),
    "j9.csv": ("Tool_5_Maryland_L_2/30.TXT", 4, 8, 0.4),
    "j10.csv": ("Tool_5_Maryland_L_3/34.TXT", 0, 4, 0.4),
    "j11.csv": ("Tool_5_Maryland_L_2/43.TXT", 0, 3, 0.5),
    "j12.csv": ("Tool_5_Maryland_L_3/30.TXT", 0, 4, 0.4),
    "j13.csv": ("Tool_5_Maryland_L_2/40.TXT", 6, 10, 0.5),
    "j14.csv": ("Tool_5_Maryland_L_3/40.TXT", 6, 10, 0.5),
    "j15.csv": ("Tool_5_Maryland_L_2/20.TXT", 0, 3, 0.3),
    "j16.csv": ("Tool_5_Maryland_L_3/16.TXT", 0, 4, 0.2),
}

if __name__ == "__main__":
    davinci_tool(*folders(__file__), RECORDINGS)
