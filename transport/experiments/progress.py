"""Progress of an experiment on the console: the number of finished runs and the last result."""

import time
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

# Period of the lines without a terminal, wall time, s.
_LINE_EVERY_S = 10.0


class SweepProgress:
    """A progress bar on a terminal, a line every 10 s elsewhere.

    Args:
        name: Name of the experiment.
        done: Number of runs finished before.
        total: Number of all runs.
        console: Standard error, as standard output is for results.
    """

    def __init__(self, name: str, done: int, total: int, console: Console) -> None:
        self._console, self._done, self._total = console, done, total
        self._next_line_s = time.monotonic() + _LINE_EVERY_S
        self._bar: Progress | None = None
        if console.is_terminal:
            columns = (BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[last]}"))
            clocks = (TimeElapsedColumn(), TimeRemainingColumn())
            self._bar = Progress(TextColumn(name), *columns, *clocks, console=console, transient=True)
            self._task = self._bar.add_task(name, total=total, completed=done, last="")

    def __enter__(self) -> "SweepProgress":
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def advance(self, last: str) -> None:
        """Count one more finished run.

        Args:
            last: The run and its outcome.
        """
        self._done += 1
        if self._bar is not None:
            self._bar.update(self._task, completed=self._done, last=last)
        elif time.monotonic() >= self._next_line_s or self._done == self._total:
            self._next_line_s = time.monotonic() + _LINE_EVERY_S
            line = f"{self._done} of {self._total} runs done, the last {last}"
            self._console.print(line, highlight=False, soft_wrap=True)
