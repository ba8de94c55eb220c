"""Whether an answer is stable under itself: each recording is diagnosed again with the cell that its own diagnosis writes.

`python -m benchmarks.fixed_point FOLDER --kept ANSWERS [--most N] [--jobs 2]` takes each X.csv with X.yaml in the folder and in folders
inside it, such as one of `benchmarks.foreign` or of `palpd blind --keep`. Nobody needs to know what acts: a cell that holds all that was
found has no gap. It prints the share of the answers with named effects whose second diagnosis says "none", and the second answer of the
others.

A known effect must not hide a further one. `--planted N [--seed S]` plants another effect into the first N recordings, where they have
named effects, at an SNR of 10 to 60, by a law of the blind check and not of the library. It prints the share of these effects that is named
when the cell of the first answer is given.
"""

import argparse
import contextlib
import json
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from zlib import crc32

from palpd.blind.injected_cells import Host, draw_injected
from palpd.blind.plans import VARIANCE, effects_of
from palpd.blind.truth import CannotDraw, CaseSpec
from palpd.cell.cell_file import CellFile, load_cell
from palpd.documents import read_yaml
from palpd.errors import BadInput
from palpd.gap.commands import read_recording
from palpd.gap.diagnosis import Diagnosis, diagnose
from palpd.gap.model.problem import MAX_BINS
from palpd.quantities import wilson
from palpd.recording.samples import Samples
from palpd.workers import pool

STRATA = ("10-20", "20-60")
LEAST_SNR = 10.0
"""SNR from which on a further effect must be named."""


@dataclass(frozen=True)
class FurtherEffect:
    """An effect that was planted beside known ones, its SNR, and what was named: ids with their groups."""

    effect: str
    snr: float
    named: tuple[tuple[str, ...], ...]

    @property
    def is_named(self) -> bool:
        """Whether it is named, or stands in the group of a name."""
        return any(self.effect in group for group in self.named)


@dataclass(frozen=True)
class TwoAnswers:
    """The verdicts on a recording, and what was named.

    Attributes:
        second: Verdict with the cell of the first answer; None where that named no effects.
        further: What became of a further effect; None where none was planted.
    """

    stem: str
    first: str
    second: str | None
    named: tuple[str, ...] = ()
    named_again: tuple[str, ...] = ()
    further: FurtherEffect | None = None

    @property
    def line(self) -> str:
        """What is said of an answer that is not stable."""
        return f"{self.stem}: {', '.join(self.named)}; then {self.second}: {', '.join(self.named_again) or 'nothing'}"


def asked_twice(recording: Path, planted: int | None = None, *, bins: int = MAX_BINS) -> TwoAnswers:
    """Diagnose a recording with its cell file, then with the cell that the answer writes.

    Args:
        planted: Seed of a further effect; None: none is planted.
        bins: Largest number of bins of a diagnosis.
    """
    samples = read_recording(recording)

    def answer(cell: CellFile, of: Samples = samples) -> Diagnosis:
        return diagnose([of], cell, max_bins=bins, propose=False)

    first = answer(load_cell(recording.with_suffix(".yaml")))
    if first.verdict != "effects":
        return TwoAnswers(recording.stem, first.verdict, None)
    known = first.enriched_cell()
    second = answer(known)
    named, again = (tuple(effect.id for effect in one.effects) for one in (first, second))
    twice = TwoAnswers(recording.stem, first.verdict, second.verdict, named, again)
    if planted is None or (case := with_further_effect(recording, samples, named, planted)) is None:
        return twice
    effect, snr, changed = case
    groups = tuple((each.id, *each.indistinguishable_from) for each in answer(known, changed).effects)
    return replace(twice, further=FurtherEffect(effect, snr, groups))


def answer_in(recording: Path, planted: int | None, bins: int, kept: Path) -> TwoAnswers:
    """The same; an answer that stands in the folder `kept` is taken from there."""
    file = kept / f"{recording.stem}{'' if planted is None else f'-{planted}'}.json"
    if not file.exists():
        file.write_text(json.dumps(asdict(asked_twice(recording, planted, bins=bins))), encoding="utf-8")
    content = json.loads(file.read_text(encoding="utf-8"))
    further = None if content["further"] is None else FurtherEffect(**content.pop("further"))
    return TwoAnswers(**content | {"further": further})


def with_further_effect(recording: Path, samples: Samples, named: tuple[str, ...], seed: int) -> tuple[str, float, Samples] | None:
    """Plant a further effect into a recording.

    Args:
        named: Effects that are known; these and what cannot be distinguished from them are not planted.
        seed: Seed of the effect.

    Returns:
        The effect, its SNR and the recording with it; None where the recording shows none at that SNR.
    """
    host = Host(recording.stem, read_yaml(recording.with_suffix(".yaml"), error=BadInput).keys_and_values(), samples, named)
    number = crc32(recording.stem.encode())
    offered = [effect for effect in effects_of("injected")["foreign"] if effect not in VARIANCE]
    for turn in range(len(offered)):
        spec = CaseSpec("injected", number, "foreign", (offered[(number + turn) % len(offered)],), STRATA[number // 64 % 2], extra=True)
        with contextlib.suppress(CannotDraw):
            case = draw_injected(spec, seed, [host])
            if (snr := case.truth["effects"][0]["snr"] or 0.0) >= LEAST_SNR:
                return spec.effects[0], snr, case.samples
    return None


def main() -> None:
    """Ask about all recordings of a folder, and print the share of stable answers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--most", type=int, default=10**6, help="number of recordings, at most")
    parser.add_argument("--planted", type=int, default=0, help="number of recordings that a further effect is planted into, the first ones")
    parser.add_argument("--seed", type=int, default=1, help="seed of the further effects")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--bins", type=int, default=MAX_BINS)
    parser.add_argument("--kept", type=Path, required=True, help="folder of the answers; what stands in it is not asked again")
    options = parser.parse_args()
    options.kept.mkdir(parents=True, exist_ok=True)
    recordings = [path for path in sorted(options.folder.rglob("*.csv")) if path.with_suffix(".yaml").exists()][: options.most]
    seeds = [options.seed if place < options.planted else None for place in range(len(recordings))]
    named = stable = 0
    further: list[FurtherEffect] = []
    with pool(options.jobs) as workers:
        for one in workers.map(partial(answer_in, bins=options.bins, kept=options.kept), recordings, seeds):
            named, stable = named + (one.second is not None), stable + (one.second == "none")
            if one.second not in (None, "none"):
                print(one.line, flush=True)
            if one.further is not None:
                further.append(one.further)
                if not one.further.is_named:
                    names = ", ".join(group[0] for group in one.further.named) or "nothing"
                    print(f"{one.stem}: {', '.join(one.named)} known, {one.further.effect} of SNR {one.further.snr:.0f} planted: {names}")
    low, high = wilson(stable, named)
    print(f"stable: {stable} of {named} answers with named effects ({low:.0%} to {high:.0%}), of {len(recordings)} recordings")
    if further:
        seen = sum(each.is_named for each in further)
        low, high = wilson(seen, len(further))
        print(f"further effect named, itself or in a group: {seen} of {len(further)} ({low:.0%} to {high:.0%})")


if __name__ == "__main__":
    main()
