"""Progress of an experiment on the console: the number of finished runs and the last result."""

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from transport.flight.progress import ConsoleProgress


class SweepProgress(ConsoleProgress):
    """Progress of a sweep."""

    def __init__(self, name: str, done: int, total: int, console: Console) -> None:
        status = (BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[last]}"))
        super().__init__(console, TextColumn(name), *status, TimeElapsedColumn(), TimeRemainingColumn())
        self._done, self._total = done, total
        if self._bar is not None:
            self._task = self._bar.add_task(name, total=total, completed=done, last="")

    def advance(self, last: str) -> None:
        """Count one more finished run, described with its outcome."""
        self._done += 1
        if self._bar is not None:
            self._bar.update(self._task, completed=self._done, last=last)
        elif self._is_line_due() or self._done == self._total:
            self.say(f"{self._done} of {self._total} runs done, the last {last}")
