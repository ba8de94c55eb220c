"""What several commands print: a run, a demonstration."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from palpd.cli.last_ticks import print_last_ticks
from palpd.cli.options import display, terminal
from palpd.cli.tables import depth_table, diagnosis_lines, site_tables
from palpd.history.stored import RECORDING

if TYPE_CHECKING:
    from palpd.daemon.demo import Demonstration
    from palpd.daemon.run_result import RunResult


def print_run(result: "RunResult") -> None:
    """Print the tables of a run, its notes, the ticks before a stop, and the verdict."""
    show, card = terminal().print, result.get("model_card")
    if result["sites"]:
        show(depth_table(result["sites"]))
        show(*site_tables(result["sites"], card["bias_N"] if card else None), sep="\n")
        show("Inertial model: " + (f"{card['rmse_N'] * 1e3:.0f} mN rmse" if card else "none, nothing was corrected") + ".")
    if dry := result.get("dry"):
        x_N, y_N, z_N = dry["force_N"]
        x_m, y_m, z_m, *rotation_rad = dry["tcp_pose"]
        show(f"Force ({x_N:+.2f}, {y_N:+.2f}, {z_N:+.2f}) N in base axes, tared; noise of fz {dry['noise_N'] * 1e3:.0f} mN rms.")
        turned = ", ".join(f"{each:+.3f}" for each in rotation_rad)
        show(f"Tip at ({x_m:+.4f}, {y_m:+.4f}, {z_m:+.4f}) m in base axes, rotation vector ({turned}) rad. Nothing was commanded.")
    for note in result["notes"]:
        show(f"note: {note}", style="yellow")
    print_last_ticks(result["last_ticks"])
    show(f"{result['verdict']}: {result['recording'] or 'nothing was recorded'}")


def print_check(figures: Mapping[str, Any]) -> None:
    """Print what `palpd check` measured, how far that is off, and what the diagnosis of the puck says of a change.

    Args:
        figures: As its `--json` holds them.
    """
    from palpd.cli.tables import check_table

    show = terminal().print
    show(check_table(figures["figures"]))
    if figures["baseline"] is not None:
        show(f"First of a new baseline: {figures['baseline']['note']}", soft_wrap=True)
    if figures["note"]:
        show(f"note: {figures['note']}", soft_wrap=True)
    if figures["diagnosis"] is not None:
        show(f"The diagnosis of the puck's recording names {', '.join(figures['named']) or 'nothing'}.")
    show(f"{'ok: nothing has changed' if figures['level'] == 'ok' else figures['level']}: {figures['recording']}", soft_wrap=True)


def print_injections(figures: Mapping[str, Any], unopened: Sequence[Path]) -> None:
    """Print what injections say of a cell.

    Args:
        figures: As the `--json` of `palpd inject` holds them.
        unopened: Runs whose seal was never opened.
    """
    say = display().say
    for limit in figures["limits"]:
        say(f"  {limit['effect']}: {limit['words']} {limit['text']}; named in {limit['named']} of {limit['injections']}")
    for sentence in figures["sentences"]:
        say(sentence)
    for path in unopened:
        recording = path.with_suffix(RECORDING)
        first = "" if path == recording else f"palpd recover {path}, then "
        say(f"{path} was never opened; {first}palpd inject --open {recording} does it.")


def say_injected(recordings: Sequence[Path]) -> None:
    """Say of runs of `palpd inject` what was read of them."""
    from palpd.recording.reader import read_header

    for path in recordings:
        if path.suffix == RECORDING and read_header(path).get("injection"):
            display().say(f"{path.name} is a run of palpd inject: this is what the sensor measured, without what was planted.")


def print_demonstration(demonstration: "Demonstration") -> None:
    """Print what `palpd demo` measured, or its diagnosis."""
    show, result, card = terminal().print, demonstration.result, demonstration.card
    if "diagnosis" in result:
        for line in diagnosis_lines(result["diagnosis"]):
            show(line)
        if check := result["diagnosis"].get("another_motion"):
            show(check["sentence"])
        return
    print_last_ticks(result["last_ticks"])
    if card is None:
        return
    if result["sites"]:
        show(depth_table(result["sites"]))
        show(*site_tables(result["sites"], card.bias_N), sep="\n")
    show(
        f"Inertial model: b - m a learned from the free motion above, {card.n} points, rmse {card.rmse_N * 1e3:.0f} mN: a bias of "
        f"{card.bias_N:+.3f} N and a mass of {card.mass_kg:.3f} kg, {card.inertial_rms_N * 1e3:.1f} mN rms of inertia. "
        "The bias of each press is followed from there by the running zero."
    )
    for note in result["notes"]:
        show(f"note: {note}")
    loop = result["loop"]
    if "work_us_p50" in loop:  # no wires, no timing
        show(
            f"Loop: {loop['ticks']} ticks, {loop['missed']} missed, work p50 {loop['work_us_p50']:.0f} µs, "
            f"p99 {loop['work_us_p99']:.0f} µs."
        )
    show(f"{result['verdict']}: {result['recording'] or 'nothing was recorded'}" + (f" ({result['reason']})" if result["reason"] else ""))
