"""The commands by what a person does with them: the order of `palpd --help` and of docs/reference/commands.md."""

import re
from typing import Any

from typer.core import TyperGroup

GROUPS = {
    "Try it without a cell": ("demo", "sim", "emulate"),
    "Set up a cell": (
        "setup", "commission", "init", "check-config", "doctor", "calibrate", "stiffness", "free-motion", "train", "install", "migrate",
    ),
    "Palpate": ("check", "run", "map", "inject", "level-test", "retract"),
    "Run the service and speak to it": (
        "serve", "web", "stream", "alarms", "status", "arm", "start", "pause", "resume", "abort", "clear", "recover-robot", "jobs", "job",
        "plans", "controls",
    ),
    "Look back at runs": ("runs", "info", "report", "replay", "export", "recover"),
    "Use recordings of any machine": ("import", "cell-from", "analyse"),
    "Find why measurement and simulation differ": ("diagnose", "simulate", "effects", "tolerances", "resolve", "export-sim"),
    "Check palpd itself": ("blind", "study", "arena"),
}  # fmt: skip
"""Every command once, by the heading that it stands under."""
ORDER = tuple(name for names in GROUPS.values() for name in names)
WIDTH = max(map(len, ORDER))
LONGEST_SENTENCE = 200
"""Letters of the first sentence of a command that counts; longer ones would be cut off."""


class GroupedCommands(TyperGroup):
    """Lists the commands below the headings of `GROUPS`, each with its first clause; its own help has the whole."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ARG002 - as typer calls it
        """Write the list.

        Args:
            ctx: What typer knows of the command line.
            formatter: Takes the lines.
        """
        for title, names in GROUPS.items():
            with formatter.section(title):
                sentences = [self.commands[name].get_short_help_str(LONGEST_SENTENCE) for name in names]
                formatter.write_dl([(name.ljust(WIDTH), _first_clause(each)) for name, each in zip(names, sentences, strict=True)])


def _first_clause(sentence: str) -> str:
    return re.split("[:;]", sentence)[0].rstrip(".") + "."
