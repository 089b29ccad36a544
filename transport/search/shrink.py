"""Shrinking: from a case that fails to a minimal one that still fails.

Greedy, in the manner of delta debugging: the first simpler neighbour that fails takes the place of
the case, until none does.
"""

from collections.abc import Callable
from dataclasses import replace

from transport.protocol.scenario.errors import ScenarioError
from transport.search.candidate import Candidate
from transport.search.evaluation import Evaluation, Problem

_MOST = 400  # evaluations of one shrinking: each takes about a second
Progress = Callable[[Candidate, int], None]


class Shrinker:
    """State of one shrinking: the minimal case so far, and how many evaluations it took."""

    def __init__(self, problem: Problem, candidate: Candidate, progress: Progress) -> None:
        self.problem = problem
        self.candidate = candidate
        self.evaluations = 0
        self._progress = progress
        self._failed: dict[str, bool] = {}  # by key of problem and candidate

    def run(self) -> None:
        """Shrink until no simpler neighbour fails, or the evaluations are used up."""
        while self._step():
            pass
        self._shrink_team()

    def _step(self) -> bool:
        """Replace the case by a simpler one that fails; return whether there was one."""
        for simpler in self.candidate.simpler():
            if not simpler.events:
                continue
            if self._fails(self.problem, simpler):
                self.candidate = simpler
                self._progress(simpler, self.evaluations)
                return True

        return False

    def _shrink_team(self) -> None:
        """Replace the team by the smallest one with which the case fails."""
        for base in self.candidate.smaller_teams(self.problem.base):
            problem = replace(self.problem, base=base)
            if self._fails(problem, self.candidate):
                self.problem = problem
                self._progress(self.candidate, self.evaluations)
                return

    def _fails(self, problem: Problem, candidate: Candidate) -> bool:
        key = problem.key(candidate)
        if key not in self._failed:
            if self.evaluations >= _MOST:
                return False
            self.evaluations += 1
            try:
                self._failed[key] = problem.evaluate(candidate).failed
            except ScenarioError:
                self._failed[key] = False

        return self._failed[key]


def shrunk(
    problem: Problem, candidate: Candidate, progress: Progress
) -> tuple[Problem, Candidate, Evaluation]:
    """Return a minimal case that fails, with its scenario, and its evaluation."""
    shrinker = Shrinker(problem, candidate, progress)
    shrinker.run()
    return shrinker.problem, shrinker.candidate, shrinker.problem.evaluate(shrinker.candidate)
