"""Shrinking: from a case that fails to a minimal one that still fails.

Greedy, in the manner of delta debugging: events are removed, then each is made simpler as long as
the case fails, until no simpler neighbour does. Neighbours are flown several at a time, but their
results are used in order, so that the minimal case does not depend on the number of workers.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from transport.search.candidate import Candidate
from transport.search.evaluation import REFUSED, CaseVerdict, Evaluation, SearchProblem

_MOST = 400  # evaluations of one shrinking: each takes about a second
Evaluate = Callable[[SearchProblem, Sequence[Candidate]], Sequence[Evaluation]]
Progress = Callable[[Candidate, int], None]


class Shrinker:
    """State of one shrinking: the minimal case so far, and how many evaluations it took.

    Attributes:
        verdict: Whether perfect information saves the minimal case; known after `run`.
    """

    def __init__(
        self,
        problem: SearchProblem,
        candidate: Candidate,
        evaluate: Evaluate,
        progress: Progress,
        *,
        at_once: int = 1,
    ) -> None:
        """Args: evaluate: Returns evaluations in order. at_once: Candidates it is given at a time."""
        self.problem = problem
        self.candidate = candidate
        self.evaluations = 0
        self.verdict = CaseVerdict(beyond_physics=None, reason="it was not simulated")
        self._evaluate = evaluate
        self._progress = progress
        self._at_once = at_once
        self._survivors: set[str] = set()  # keys of problem and candidate that do not fail

    def run(self) -> None:
        """Shrink until no simpler neighbour fails, or the evaluations are used up."""
        changed = True
        while changed:
            removed = self._repeat(Candidate.fewer)
            simplified = self._simplify_each()
            changed = removed or simplified
        self._shrink_team()

    def _simplify_each(self) -> bool:
        """Make one event after the other as simple as possible; return whether one became simpler."""
        changed = False
        for index in range(len(self.candidate.events)):
            became_simpler = self._repeat(partial(_simpler, index))
            changed = changed or became_simpler
        return changed

    def _repeat(self, neighbours: Callable[[Candidate], Sequence[Candidate]]) -> bool:
        """Replace the case by its first neighbour that fails until none does; return whether one did."""
        changed = False
        while (simpler := self._first_failing(neighbours(self.candidate))) is not None:
            self.candidate = simpler
            self._progress(simpler, self.evaluations)
            changed = True
        return changed

    def _first_failing(self, candidates: Sequence[Candidate]) -> Candidate | None:
        """Return the first of some candidates that fails."""
        key = self.problem.key
        untried = [one for one in candidates if one.events and key(one) not in self._survivors]

        for first in range(0, len(untried), self._at_once):
            batch = untried[first : first + self._at_once]
            for candidate, evaluation in zip(
                batch, self._evaluate(self.problem, batch), strict=True
            ):
                if self.evaluations >= _MOST:
                    return None
                self.evaluations += 1
                if evaluation.failed:
                    return candidate
                self._survivors.add(evaluation.key)

        return None

    def _shrink_team(self) -> None:
        """Replace the team by the smallest one with which the case is the same.

        It fails, by its events, and perfect information saves the smaller team as it does the whole
        one, or neither. Cases with perfect information are of another scenario: they are simulated
        in this process, and not among the evaluations.
        """
        whole = self.problem
        self.verdict = whole.verdict(self.candidate)

        for base in self.candidate.smaller_teams(whole.base):
            self.problem = replace(whole, base=base)
            fails_by_events = self._holds_without_events()
            if not fails_by_events or self._first_failing([self.candidate]) is None:
                continue
            verdict = self.problem.verdict(self.candidate)
            if verdict.beyond_physics == self.verdict.beyond_physics:
                self._progress(self.candidate, self.evaluations)
                return
        self.problem = whole

    def _holds_without_events(self) -> bool:
        """Return whether the team keeps the limit without any event."""
        (evaluation,) = self._evaluate(self.problem, [Candidate(())])
        self.evaluations += 1
        return not evaluation.failed and evaluation.outcome != REFUSED


def _simpler(index: int, candidate: Candidate) -> Sequence[Candidate]:
    """Return the candidates in which one event is simpler."""
    return candidate.simpler(index)
