"""The cell that is being set up: its folder, its files, and the operator who answers."""

import fcntl
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from palpd.config import Config, load_config
from palpd.daemon.devices import Build
from palpd.daemon.display import Display
from palpd.daemon.session import ForegroundHost
from palpd.daemon.stored_state import State
from palpd.daemon.wiring import devices
from palpd.errors import ConfigError, Refused
from palpd.files import check_folder, read_text, write_text
from palpd.migration import with_values


class NoOperator(Refused):
    """Nobody answers."""


class StepOperator(Protocol):
    """Whoever stands at the cell, at a terminal or a page. `ask` and `choose` raise NoOperator where nobody answers."""

    def say(self, sentence: str) -> None:
        """Show a sentence."""

    def ask(self, question: str, usual: str = "") -> str:
        """Ask for a text; an empty answer is the usual one."""
        ...

    def choose(self, question: str, answers: Sequence[str], moves: str = "") -> str:
        """Ask for one of the answers; the first is the usual one. After the answer `moves` the arm moves, so it is never the first."""
        ...


@dataclass(frozen=True)
class SetupCell:
    """What a step works on.

    Attributes:
        folder: Folder of config.yaml and plan.yaml; either may be missing.
        operator: Answers.
        display: Shows the progress of a run.
        robot: Address of the controller; None: the operator is asked.
        sensor: Port of the sensor; None: it is searched for.
        build: Opens the devices of a run.
    """

    folder: Path
    operator: StepOperator
    display: Display
    robot: str | None = None
    sensor: str | None = None
    build: Build = devices

    @property
    def config_file(self) -> Path:
        """config.yaml of the cell."""
        return self.folder / "config.yaml"

    @property
    def config(self) -> Config:
        """What config.yaml says now. Raises ConfigError."""
        return load_config(self.config_file)

    @property
    def state(self) -> State:
        """The state folder, also before there is a configuration."""
        return State(self.config.paths.state if self.config_file.exists() else self.folder.resolve() / "state")

    @property
    def host(self) -> ForegroundHost:
        """Carries out runs with the configuration as it is now."""
        return ForegroundHost(self.config, self.build, self.display, self.confirms)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Make the folder, and hold it within the context against another set-up. Raises BadInput, or Refused where one is under way."""
        check_folder(self.folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(self.folder, os.O_RDONLY)
        try:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)  # the kernel lets it go, however this process ends
            except BlockingIOError:
                raise Refused(f"another palpd setup of {self.folder} is under way, at a terminal or in a page; end that first") from None
            yield
        finally:
            os.close(descriptor)

    def agrees(self, question: str) -> bool:
        """Ask a question that yes or no answers; Enter alone is yes."""
        return self.operator.choose(question, ("yes", "no")) == "yes"

    def confirms(self, question: str, moves: bool = False) -> bool:
        """Ask whether the operator has looked at the cell; Enter alone is no. With `moves` the arm moves after a yes."""
        return self.operator.choose(question, ("no", "yes"), "yes" * moves) == "yes"

    def numbers(self, question: str, usual: str, count: int = 1) -> tuple[float, ...]:
        """Ask for `count` numbers with commas between, again until they are."""
        while True:
            answer = self.operator.ask(question, usual)
            try:
                values = tuple(float(word) for word in answer.split(","))
            except ValueError:
                values = ()
            if len(values) == count:
                return values
            self.operator.say(
                f"{answer!r} is not understood, expected {count} number{'s' * (count > 1)} with commas between; type them again."
            )

    def change(self, values: Mapping[tuple[str, str], object]) -> None:
        """Set keys of config.yaml, and keep its comments. Raises ConfigError or BadInput, and the file stays as it was."""
        before = read_text(self.config_file, error=ConfigError)
        write_text(self.config_file, with_values(before, values), own=True)
        try:
            load_config(self.config_file)
        except ConfigError:
            write_text(self.config_file, before, own=True)
            raise
