"""Presses that a map needs to find a 10 mm inclusion in 60 × 60 mm, against a raster of equal presses.

python benchmarks/mapping.py [--fields N]
"""

import argparse
import math

import numpy as np

from palpd.analysis.stiffness_map import HARD, Field, raster, search
from palpd.study.inclusion_field import EmulatedField


def raster_presses(emulated: EmulatedField, where: Field) -> int:
    """Presses of a raster until one is hard against the median of all so far."""
    moduli: list[float] = []
    for number, place in enumerate(raster(where), start=1):
        moduli.append(emulated.press(place))
        if number > 3 and math.log(moduli[-1] / float(np.median(moduli))) > HARD:
            return number
    return len(moduli)


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fields", type=int, default=50)
    count, where = parser.parse_args().fields, Field()
    whole = len(raster(where))
    presses, first, hits, away_m = [], [], [], []
    for seed in range(count):
        emulated = EmulatedField(where, seed)
        survey, mapped = search(emulated.press, where)
        presses.append(len(survey.places_m))
        first.append(raster_presses(EmulatedField(where, seed), where))
        assert emulated.inclusion is not None
        away = math.dist(mapped.found_m, emulated.inclusion[:2]) if mapped.found_m is not None else math.inf
        hits.append(away < where.inclusion_m / 2.0)
        away_m.append(away)
    plain = [search(EmulatedField(where, 1000 + seed, contrast=0.0).press, where) for seed in range(count // 2)]
    alarms = sum(mapped.found_m is not None for _, mapped in plain)
    print(f"{count} fields with an inclusion: {sum(hits)} found within its own radius, median {np.median(away_m) * 1e3:.1f} mm off.")
    print(f"Presses: mean {np.mean(presses):.0f}, in 95 % of fields at most {np.percentile(presses, 95):.0f}; ", end="")
    print(f"a raster of 5 mm has {whole} and meets something hard after {np.mean(first):.0f} on the mean: ", end="")
    print(f"{100 * np.mean(presses) / whole:.0f} % of the raster, {100 * np.mean(presses) / np.mean(first):.0f} % of that way.")
    needed = [len(survey.places_m) for survey, _ in plain]
    print(f"{len(plain)} plain fields: {alarms} false alarms; {np.mean(needed):.0f} presses until nothing is likely anywhere, ", end="")
    print(f"{100 * np.mean(needed) / whole:.0f} % of the raster.")


if __name__ == "__main__":
    main()
