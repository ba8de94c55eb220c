"""What the cases of a check shall be: every kind has its share, every effect and stratum its turn.

The contract is docs/reference/contract.md.
"""

from dataclasses import replace

import numpy as np

from palpd.blind.laws import FOREIGN_LAWS, INDISTINGUISHABLE, LIBRARY_LAWS, NOVEL_LAWS
from palpd.blind.mujoco.effects import LISTED
from palpd.blind.mujoco.unlisted import UNLISTED
from palpd.blind.truth import CASE_KINDS, CaseKind, CaseSpec, Source

SHARES: dict[Source, dict[CaseKind, float]] = {
    "drawn": {"healthy": 0.2, "library": 0.27, "foreign": 0.2, "two": 0.09, "removed": 0.12, "novel": 0.12},
    "mujoco": {"healthy": 0.2, "library": 0.22, "foreign": 0.26, "two": 0.14, "novel": 0.18},
    "injected": {"healthy": 0.2, "foreign": 0.48, "two": 0.14, "novel": 0.18},
}
"""Share of each kind among the cases of a source."""
SINGLE_STRATA = ("20-60", "6-10", "10-20", "20-60", "6-10", "10-20", "> 60")
"""Strata of single effects, in turn: most of them where a diagnosis is hard."""
LARGE_STRATA = ("20-60", "> 60")
"""Strata of effects that were left out of the library: where there is enough to see that nothing listed fits."""
NOVEL_STRATA = ("20-60", "10-20")
"""Strata of effects outside the list, in turn: those of the targets for learned laws."""
FIRST_EXTRA, FIRST_UNLISTED, FIRST_COARSE = 900_000, 950_000, 980_000
"""Index of the first extra case, of the first one with an effect outside the list, and of the first one with coarse steps."""
COARSEST_OVER_NOISE = 8.0
"""Largest coarse step over the noise; the smallest is 1, and 4.4 is that of a HEX-70 (0.131 N, noise 0.03 N)."""
VARIANCE = {law.effect for law in LIBRARY_LAWS if law.variance}
"""Effects that change scatter and not the mean."""


def effects_of(source: Source) -> dict[CaseKind, list[str]]:
    """The effects that a source plants, by kind of case.

    An effect of MuJoCo's that the drawn cells do not list counts as outside the list.
    """
    listed = {law.effect for law in LIBRARY_LAWS}
    foreign, novel = sorted({law.effect for law in FOREIGN_LAWS}), sorted({law.effect for law in NOVEL_LAWS})
    if source == "mujoco":
        same, other = ([e.id for e in LISTED if e.law == law and e.id in listed] for law in ("same", "other"))
        outside = [e.id for e in (*LISTED, *UNLISTED) if e.id not in listed]
        return {"library": same, "foreign": other, "two": sorted({*same, *other} - VARIANCE), "novel": outside}
    means = sorted(listed - VARIANCE)
    if source == "injected":
        return {"foreign": foreign, "two": means, "novel": novel}
    return {"library": sorted(listed), "foreign": foreign, "two": means, "removed": means, "novel": novel}


def plan(source: Source, cases: int, seed: int, hosts: int = 0) -> list[CaseSpec]:
    """Choose kind, effects and stratum of every case; a shorter check is a fair sample of a longer one.

    Args:
        source: Where the cases come from.
        seed: Seed of the order of the effects.
        hosts: Number of real recordings that effects are planted into; each comes once as it is, before all others. 0: none.

    Returns:
        One specification a case.
    """
    random = np.random.default_rng([seed, 7, len(source)])
    shares = {kind: share for kind, share in SHARES[source].items() if not hosts or kind != "healthy"}
    names = {kind: [effects[int(k)] for k in random.permutation(len(effects))] for kind, effects in effects_of(source).items()}
    specs = [CaseSpec(source, index, "healthy", (), "20-60") for index in range(min(hosts, cases))]
    counts = dict.fromkeys(CASE_KINDS, 0)
    for index in range(len(specs), cases):
        kind = min(shares, key=lambda k: (counts[k] + 0.5) / shares[k])
        n = counts[kind]
        counts[kind] += 1
        if kind == "healthy":
            specs.append(CaseSpec(source, index, kind, (), "20-60"))
            continue
        mine = names[kind]
        effect = mine[n % len(mine)]
        if kind == "two":
            free = [e for e in mine if e != effect and e not in INDISTINGUISHABLE.get(effect, ())]
            specs.append(CaseSpec(source, index, kind, (effect, free[int(random.integers(len(free)))]), ("10-20", "20-60")[n % 2]))
        elif kind == "removed":
            specs.append(CaseSpec(source, index, kind, (effect,), LARGE_STRATA[n // len(mine) % 2]))
        elif kind == "novel":
            specs.append(CaseSpec(source, index, kind, (effect,), NOVEL_STRATA[(n % len(mine) + n // len(mine)) % 2]))
        else:
            specs.append(CaseSpec(source, index, kind, (effect,), SINGLE_STRATA[(n + n // len(mine)) % len(SINGLE_STRATA)]))
    return specs


def plan_large(cases: int, seed: int) -> list[CaseSpec]:
    """Further drawn cells with one effect of SNR > 20, a law of the contract, and no indistinguishable effect.

    Args:
        seed: Seed of the order of the effects.

    Returns:
        One specification a case; they count in the line of their class alone.
    """
    random = np.random.default_rng([seed, 11])
    mine = [e for e in effects_of("drawn")["library"] if e not in VARIANCE and e not in INDISTINGUISHABLE]
    order = [mine[int(k)] for k in random.permutation(len(mine))]
    return [
        CaseSpec("drawn", FIRST_EXTRA + n, "library", (order[n % len(order)],), LARGE_STRATA[n // len(order) % 2], extra=True)
        for n in range(cases)
    ]


def plan_unlisted(source: Source, cases: int, seed: int) -> list[CaseSpec]:
    """Further cases with an effect outside the list, every effect in turn.

    Args:
        source: Where the cases come from.
        seed: Seed of the order of the effects.

    Returns:
        One specification a case; they count in the lines of learned laws alone.
    """
    random = np.random.default_rng([seed, 13, len(source)])
    mine = effects_of(source)["novel"]
    order = [mine[int(k)] for k in random.permutation(len(mine))]
    return [
        CaseSpec(
            source, FIRST_UNLISTED + n, "novel", (order[n % len(order)],), NOVEL_STRATA[(n % len(order) + n // len(order)) % 2], extra=True
        )
        for n in range(cases)
    ]


def plan_coarse(source: Source, cases: int, seed: int) -> list[CaseSpec]:
    """Further cells with coarse steps: two healthy ones, then one with a listed effect, every effect in turn.

    The steps of each axis are log-uniform, drawn apart from what acts.

    Args:
        source: Where the cases come from.
        seed: Seed of the steps and of the order of the effects.

    Returns:
        One specification a case; they count in the lines of coarse steps alone.
    """
    random = np.random.default_rng([seed, 17, len(source)])
    names = effects_of(source)
    kind: CaseKind = "library" if "library" in names else "foreign"
    mine = [e for e in names[kind] if e not in VARIANCE]
    order = [mine[int(k)] for k in random.permutation(len(mine))]
    specs = []
    for n, (lateral, vertical, torque) in enumerate((COARSEST_OVER_NOISE ** random.uniform(size=(cases, 3))).tolist()):
        spec = CaseSpec(source, FIRST_COARSE + n, "healthy", (), "20-60", extra=True, steps_over_noise=(lateral, vertical, torque))
        turn, place = divmod(n, 3)
        if place == 2:
            stratum = SINGLE_STRATA[(turn + turn // len(order)) % len(SINGLE_STRATA)]
            spec = replace(spec, kind=kind, effects=(order[turn % len(order)],), stratum=stratum)
        specs.append(spec)
    return specs
