"""Makes recordings/ from a checkout of github.com/abubakardawood/tissue-phantom-material-database.

`python -m benchmarks.arena.silicone_soft.convert FOLDER`
"""

from benchmarks.arena.converters import folders, silicone_press

RECORDINGS = {
    "h1.csv": "EF10_50T/EF10_50T_A1.csv",
    "h2.csv": "EF10_50T/EF10_50T_A3.csv",
    "h3.csv": "EF10_50T/EF10_50T_A5.csv",
    "h4.csv": "EF10_50T/EF10_50T_B2.csv",
    "h5.csv": "EF10_50T/EF10_50T_B4.csv",
    "j1.csv": "EF10_25T/EF10_25T_A3.csv",
    "j2.csv": "EF10_75T/EF10_75T_B1.csv",
    "j3.csv": "EF10_37_5T/EF10_37_5T_A2.csv",
    "j4.csv": "EF10_62_5T/EF10_62_5T_A1.csv",
    "j5.csv": "EF30_50T/EF30_50T_B4.csv",
    "j6.csv": "EF10_50T/EF10_50T_A2.csv",
    "j7.csv": "EF10_25T/EF10_25T_B2.csv",
    "j8.csv": "EF10_50T/EF10_50T_B3.csv",
    "j9.csv": "EF10_37_5T/EF10_37_5T_B4.csv",
    "j10.csv": "EF10_100T/EF10_100T_B5.csv",
    "j11.csv": "EF10_75T/EF10_75T_A4.csv",
    "j12.csv": "EF10_50T/EF10_50T_B1.csv",
    "j13.csv": "EF30_50T/EF30_50T_A1.csv",
    "j14.csv": "EF10_50T/EF10_50T_B5.csv",
    "j15.csv": "EF10_12_5T/EF10_12_5T_A5.csv",
    "j16.csv": "EF10_62_5T/EF10_62_5T_B3.csv",
    "j17.csv": "EF10_50T/EF10_50T_A4.csv",
}

if __name__ == "__main__":
    silicone_press(*folders(__file__), RECORDINGS, last_s=60)
