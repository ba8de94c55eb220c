"""Makes recordings/ from a checkout of mrl-anomaly/RoSA-data-archive-for-fault-anomaly-detection.

python benchmarks/arena/rosa_rotor/convert.py ORIGINAL_FOLDER
"""

import csv
import json
import math
import sys
from pathlib import Path

HERE = Path(__file__).parent
FOLDERS = {"H": "Healthy Mode", "D": "Manual D Mode", "N": "Manual N Mode", "V": "MC-generated V Mode"}
LONGEST_S = 20.0

# number of the sequence in the archive, by the name it has here
HEALTHY = {"h1.csv": 112, "h2.csv": 123, "h3.csv": 118, "h4.csv": 120, "h5.csv": 106, "h6.csv": 131, "h7.csv": 44, "h8.csv": 84}
JUDGED = {
    "j1.csv": 405, "j2.csv": 227, "j3.csv": 86, "j4.csv": 424, "j5.csv": 301, "j6.csv": 213, "j7.csv": 134, "j8.csv": 412,
    "j9.csv": 107, "j10.csv": 201, "j11.csv": 400, "j12.csv": 321, "j13.csv": 119, "j14.csv": 220, "j15.csv": 409, "j16.csv": 39,
    "j17.csv": 414, "j18.csv": 209, "j19.csv": 110, "j20.csv": 427, "j21.csv": 305, "j22.csv": 216, "j23.csv": 128, "j24.csv": 404,
    "j25.csv": 207, "j26.csv": 47, "j27.csv": 420, "j28.csv": 226, "j29.csv": 122, "j30.csv": 411, "j31.csv": 330, "j32.csv": 211,
    "j33.csv": 406, "j34.csv": 88, "j35.csv": 222, "j36.csv": 413,
}  # fmt: skip
WHY = {
    "H": "The makers ran it in healthy mode: normal damping load of 15 ohm, no tool on the shaft.",
    "D": "The makers lowered the resistance of the damping motor, which brakes the shaft. Its torque grows with the speed. "
    "The shaft turns one way at nearly one speed, so a constant friction looks almost the same and counts too.",
    "N": "The makers pressed a tool on the side of the shaft. That the load rubs is physics, and the effort rises with it.",
    "V": "The makers pressed a vibrating tool on the side of the shaft. The load rubs; its frequency is hardly seen in speed and effort.",
}


def folder(number: int) -> str:
    """The mode of a sequence follows from its number."""
    return {2: "N", 3: "V", 4: "D"}.get(number // 100, "H")


def rows(original: Path, number: int) -> list[dict]:
    """Rows of one sequence, by name of column."""
    with (original / FOLDERS[folder(number)] / f"merged_data{number}.csv").open(encoding="utf-8-sig", newline="") as file:
        head = [name.strip() for name in next(csv.reader(file))]
        table = [dict(zip(head, row, strict=False)) for row in csv.reader(file)]
    start = float(table[0]["Time"])
    return [row for row in table if float(row["Time"]) - start <= 1000 * LONGEST_S]


def write(path: Path, table: list[dict]) -> None:
    """The angle is the integral of the measured speed (trapezoids); the torque is the effort with its sign turned."""
    start, angle, before = float(table[0]["Time"]), 0.0, None
    lines = ["t_s,angle_rad,torque_Nm"]
    for row in table:
        t, speed = (float(row["Time"]) - start) / 1000, float(row["Actual Speed"]) * 2 * math.pi / 60
        if before is not None:
            if t <= before[0]:
                continue
            angle += (t - before[0]) * (speed + before[1]) / 2
        before = t, speed
        lines.append(f"{t:.3f},{angle:.3f},{-float(row['Shaft Control Effort']):.2f}")
    path.write_text("\n".join(lines) + "\n")


def truth(table: list[dict], kind: str) -> dict:
    """What the archive's own columns state of this sequence, within the rows that are kept."""
    if kind == "H":
        return {"truth": "healthy", "causes": [], "known": "annotated", "why": WHY["H"]}
    start = float(table[0]["Time"])
    if kind == "D":
        acts = [float(row["D-mode attribute"]) != 15 for row in table]
        values = list(dict.fromkeys(f"{float(row['D-mode attribute']):g}" for row in table))
        name, size = (
            "more damping of the rotor",
            f"resistance of the damping motor {', '.join(values)} ohm (15 is normal, less brakes more)",
        )
    else:
        load = [float(row["N-mode attribute"]) for row in table]
        acts = [min(load[i : i + 3]) > 0.5 for i in range(len(load))]
        used = sorted(value for value in load if value > 0.5)
        size = f"lateral load of {used[len(used) // 2]:.1f} N (median while it acts), at most {used[-1]:.1f} N"
        name = "lateral load on the shaft"
        if kind == "V":
            values = sorted({int(float(row["V-mode attribute"])) for row in table} - {0})
            name, size = "vibrating lateral load on the shaft", f"{size}, vibration of {', '.join(map(str, values))} Hz"
    causes = {"D": ["cable.viscous|cable.friction"], "N": ["cable.friction"], "V": ["cable.friction|robot.vibration"]}[kind]
    onset = (float(table[acts.index(True)]["Time"]) - start) / 1000
    known = "annotated" if kind == "D" else "inferred"
    return {"truth": name, "causes": causes, "known": known, "onset_s": round(onset, 2), "size": size, "why": WHY[kind]}


def main(original: Path) -> None:
    """Writes recordings/ and truth.json."""
    (HERE / "recordings").mkdir(exist_ok=True)
    answers = {}
    for name, number in (HEALTHY | JUDGED).items():
        table = rows(original, number)
        write(HERE / "recordings" / name, table)
        if name in JUDGED:
            answers[name] = truth(table, folder(number))
    (HERE / "truth.json").write_text(json.dumps(answers, indent=1) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
