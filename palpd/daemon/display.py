"""What a person can see while the daemon works. The modules here report; whoever calls them decides how it looks."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class JobProgress:
    """Where a running job stands: what the arm does now, how many of the job's steps are done, contact force and height of the tip.

    `site` is the site that it is at; `left_s` the time that the steps to come are expected to take.
    """

    activity: str
    steps_done: int
    force_N: float
    z_m: float
    site: str | None = None
    left_s: float | None = None


ShowProgress = Callable[[JobProgress], None]


class Display(Protocol):
    """A terminal, a page, or nothing: takes sentences, the name of a long calculation, and the progress of a job."""

    def say(self, sentence: str) -> None:
        """Show one sentence and keep it."""
        ...

    def waiting(self, activity: str) -> AbstractContextManager[object]:
        """Show within the context that a calculation takes its time."""
        ...

    def job(self, steps: int) -> AbstractContextManager[ShowProgress]:
        """Show within the context how far a job of that many steps is; it yields the function that takes the progress."""
        ...


class NoDisplay:
    """Shows nothing."""

    def say(self, sentence: str) -> None:
        """Drop the sentence."""

    def waiting(self, activity: str) -> AbstractContextManager[object]:
        """Show nothing."""
        return nullcontext(activity)

    def job(self, steps: int) -> AbstractContextManager[ShowProgress]:
        """Show nothing."""
        del steps
        return nullcontext(lambda _: None)
