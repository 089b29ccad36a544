"""Progress of a search on the console: cases flown, failures, and the worst so far."""

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

from transport.flight.progress import ConsoleProgress
from transport.search.candidate import Candidate
from transport.search.evaluation import Problem
from transport.search.search import Case


class SearchProgress(ConsoleProgress):
    """A bar over the budget with the worst case so far."""

    def __init__(self, problem: Problem, budget: int, console: Console) -> None:
        super().__init__(
            console,
            BarColumn(bar_width=20),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.description}"),
        )
        self._problem = problem
        self._worst: Case | None = None
        self._task = self._bar.add_task("searching", total=budget)

    def show(self, case: Case) -> None:
        """Count a case; say it where it is the worst so far."""
        if self._worst is None or case.evaluation.robustness < self._worst.evaluation.robustness:
            self._worst = case
            self.say(self._line(case))
        self._bar.update(self._task, advance=1, description=self._line(self._worst))

    def shrinking(self, candidate: Candidate, evaluations: int) -> None:
        """Tell the minimal case so far."""
        events = f"{len(candidate.events)} events after {evaluations} runs"
        text = f"shrinking: {events}: {candidate.in_words()}"
        self._bar.update(self._task, description=text)

    def _line(self, case: Case) -> str:
        evaluation = case.evaluation
        value = self._problem.objective.in_words(evaluation.value)
        end = f" at {evaluation.failed_s:g} s" if evaluation.failed else ""
        state = "FAILS" if evaluation.failed else f"robustness {evaluation.robustness:.2f}"
        return f"case {case.number}: {state}{end}, {value}"
