"""The display of the command line: sentences as lines, a job as a bar that disappears when the job is over."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.text import Text

from palpd.daemon.display import JobProgress, ShowProgress


class TerminalDisplay:
    """Draws on a rich console."""

    def __init__(self, console: Console) -> None:
        self._console = console

    def say(self, sentence: str) -> None:
        """Print one sentence as it is."""
        self._console.print(sentence, highlight=False, markup=False, soft_wrap=True)

    def waiting(self, activity: str) -> AbstractContextManager[object]:
        """Turn a spinner beside the activity."""
        return self._console.status(Text(activity))

    @contextmanager
    def job(self, steps: int) -> Iterator[ShowProgress]:
        """Draw a bar of that many steps, with the activity, the force and the height of the tip. Without a terminal print each step."""
        if not self._console.is_terminal:
            yield self._lines(steps)
            return
        columns = TextColumn("{task.description:<34}", markup=False), BarColumn(), TextColumn("{task.fields[figures]}"), TimeElapsedColumn()
        with Progress(*columns, console=self._console, transient=True) as bar:
            task = bar.add_task("opening robot and sensor", total=steps, figures="")

            def show(progress: JobProgress) -> None:
                figures = f"{progress.force_N:6.2f} N  z {progress.z_m * 1e3:7.2f} mm"
                bar.update(task, description=progress.activity, completed=progress.steps_done, figures=figures)

            yield show

    def _lines(self, steps: int) -> ShowProgress:
        """A line for each step, for a log: a bar would be silent there until its end."""
        last: tuple[int, str] | None = None

        def show(progress: JobProgress) -> None:
            nonlocal last
            place = progress.activity.partition(":")[0]
            if (progress.steps_done, place) != last:
                last = (progress.steps_done, place)
                figures = f"{progress.force_N:.2f} N, z {progress.z_m * 1e3:.2f} mm"
                self.say(f"{progress.steps_done}/{steps}  {progress.activity}  ({figures})")

        return show
