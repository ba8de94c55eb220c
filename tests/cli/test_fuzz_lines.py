"""The fuzz of the command line tries every command."""

from benchmarks.fuzz_commands import CONTRADICTIONS, LINES, NO_DEVICE, SLOW
from tests.cli.test_application import COMMANDS


def test_every_command_of_the_command_line_is_in_the_fuzz() -> None:
    assert {line.split()[0] for line in LINES.strip().splitlines()} == set(COMMANDS)
    assert {line.split()[0] for line in CONTRADICTIONS.strip().splitlines()} <= set(COMMANDS)
    assert {*SLOW, *NO_DEVICE} <= set(COMMANDS)
