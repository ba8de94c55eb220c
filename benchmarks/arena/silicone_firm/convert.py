"""Makes recordings/ from a checkout of github.com/abubakardawood/tissue-phantom-material-database.

`python -m benchmarks.arena.silicone_firm.convert FOLDER`
"""

from benchmarks.arena.converters import folders, silicone_press

RECORDINGS = {
    "h1.csv": "EF50_25T/EF50_25T_A1.csv",
    "h2.csv": "EF50_25T/EF50_25T_A3.csv",
    "h3.csv": "EF50_25T/EF50_25T_A5.csv",
    "h4.csv": "EF50_25T/EF50_25T_B2.csv",
    "h5.csv": "EF50_25T/EF50_25T_B4.csv",
    "j1.csv": "EF50_37_5T/EF50_37_5T_B3.csv",
    "j2.csv": "EF30_12_5T/EF30_12_5T_A1.csv",
    "j3.csv": "EF50_25T/EF50_25T_B1.csv",
    "j4.csv": "EF30_0T/EF30_0T_A5.csv",
    "j5.csv": "EF30_12_5T/EF30_12_5T_B4.csv",
    "j6.csv": "EF50_37_5T/EF50_37_5T_A1.csv",
    "j7.csv": "EF50_25T/EF50_25T_B5.csv",
    "j8.csv": "EF50_12_5T/EF50_12_5T_A2.csv",
    "j9.csv": "EF50_50T/EF50_50T_A3.csv",
    "j10.csv": "EF50_12_5T/EF50_12_5T_B4.csv",
    "j11.csv": "EF50_50T/EF50_50T_B2.csv",
    "j12.csv": "EF50_25T/EF50_25T_A2.csv",
    "j13.csv": "EF50_25T/EF50_25T_A4.csv",
    "j14.csv": "EF50_0T/EF50_0T_B1.csv",
    "j15.csv": "EF50_0T/EF50_0T_A4.csv",
    "j16.csv": "EF50_25T/EF50_25T_B3.csv",
    "j17.csv": "EF30_0T/EF30_0T_B5.csv",
}

if __name__ == "__main__":
    silicone_press(*folders(__file__), RECORDINGS, last_s=60)
