"""Progress of a search on the console: cases flown, failures, and the worst so far."""

import math

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

from transport.flight.progress import ConsoleProgress
from transport.search.candidate import Candidate
from transport.search.evaluation import SearchProblem
from transport.search.optimiser import BATCH
from transport.search.search import SearchCase


class SearchProgress(ConsoleProgress):
    """A bar over the budget with the worst case so far."""

    def __init__(self, problem: SearchProblem, budget: int, console: Console) -> None:
        super().__init__(
            console,
            BarColumn(bar_width=20),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.description}"),
        )
        self._problem = problem
        self._worst: SearchCase | None = None
        self._cases = math.ceil(budget / BATCH) * BATCH  # the last batch may go beyond the budget
        self._told = 0  # cases
        self._ahead = 0  # runs since: of cases of the next batch, or of shrinking
        self._shrinking = ""
        self._task = self._bar.add_task("searching", total=self._cases)

    def simulated(self) -> None:
        """Count a run; without a terminal a line says every 10 s how far the search is."""
        self._ahead += 1
        if not self._shrinking:
            self._bar.update(self._task, completed=self._told + self._ahead)
        if self._is_line_due():
            self.say(self._where())

    def show(self, case: SearchCase) -> None:
        """Count a case; say it where it is the worst so far."""
        self._told = case.number
        self._ahead = 0
        if self._worst is None or case.evaluation.robustness < self._worst.evaluation.robustness:
            self._worst = case
            self.say(self._line(case))
        self._bar.update(self._task, completed=self._told, description=self._line(self._worst))

    def shrinking(self, candidate: Candidate, evaluations: int) -> None:
        """Tell the minimal case so far."""
        events = f"{len(candidate.events)} events after {evaluations} runs"
        if not self._shrinking:
            self._ahead = 0
        self._shrinking = f"shrinking: {events}: {candidate.in_words()}"
        self._bar.update(self._task, description=self._shrinking)

    def _where(self) -> str:
        """Return how far the search is: cases of all, or the minimal case so far."""
        if self._told >= self._cases or self._shrinking:
            return self._shrinking or f"shrinking: {self._ahead} runs"
        worst = "" if self._worst is None else f"; worst so far: {self._line(self._worst)}"
        return f"{self._told + self._ahead} of {self._cases} cases{worst}"

    def _line(self, case: SearchCase) -> str:
        evaluation = case.evaluation
        value = self._problem.objective.in_words(evaluation.value)
        end = f" at {evaluation.failed_s:g} s" if evaluation.failed else ""
        state = "FAILS" if evaluation.failed else f"robustness {evaluation.robustness:.2f}"
        return f"case {case.number}: {state}{end}, {value}"
