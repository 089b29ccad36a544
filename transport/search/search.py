"""A search for the worst case: draw, fly, learn, keep every evaluation, shrink what fails."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import orjson

from transport.experiments.cases import ExperimentError, refused
from transport.experiments.workers import Workers
from transport.protocol.scenario.files.atomic_writing import PARTIAL, Lines, write_whole
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.search.candidate import Candidate
from transport.search.evaluation import REFUSED, CaseVerdict, Evaluation, SearchProblem
from transport.search.optimiser import BATCH, Optimiser
from transport.search.shrink import Evaluate, Shrinker
from transport.search.space import Space

EVALUATIONS = "evaluations.jsonl"
_IDENTITY = "search.json"

# Evaluates candidates, in any order.
Fly = Callable[[SearchProblem, Sequence[Candidate]], Iterable[Evaluation]]


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchCase:
    """A candidate with its evaluation; one that the scenario refuses was not simulated."""

    number: int  # place in the search, from 1
    candidate: Candidate
    evaluation: Evaluation

    @property
    def order(self) -> tuple[float, int]:
        """Return the key that sorts the worst first, of equal ones the earliest."""
        return self.evaluation.robustness, self.number


@dataclass(frozen=True, slots=True, kw_only=True)
class Minimal:
    """The minimal case with its evaluation, and the verdict of perfect information."""

    problem: SearchProblem  # perhaps with a smaller team
    whole_team: int  # UAVs of the scenario that was searched
    candidate: Candidate
    evaluation: Evaluation
    verdict: CaseVerdict


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchResult:
    """Result of a search."""

    problem: SearchProblem
    without_events: Evaluation
    cases: Sequence[SearchCase]
    minimal: Minimal | None  # None: no case has failed

    @property
    def worst(self) -> SearchCase:
        """Return the case of least robustness; of equal ones the first."""
        return min(self.cases, key=lambda case: case.order)

    @property
    def first_failure(self) -> int | None:
        """Return the number of the first case that failed; None if none did."""
        return next((case.number for case in self.cases if case.evaluation.failed), None)

    @property
    def failures(self) -> int:
        """Return how many cases failed."""
        return sum(case.evaluation.failed for case in self.cases)

    @property
    def refused(self) -> Sequence[SearchCase]:
        """Return the cases that the scenario refuses."""
        return [case for case in self.cases if case.evaluation.outcome == REFUSED]


class Evaluations:
    """Evaluations by key; with a folder each is written at once, and earlier ones are read.

    A folder that is resumed does not notice changed code: neither the key of an evaluation nor the
    identity of a search has the version of this package or the content of a user's class. A search
    with changed code needs a new folder.

    Raises: ExperimentError: the folder has another search or other files, or cannot be written.
    """

    def __init__(self, folder: Path | None, identity: dict[str, Any]) -> None:
        self._by_key: dict[str, Evaluation] = {}
        self._file: Lines | None = None

        if folder is None:
            return
        try:
            folder.mkdir(parents=True, exist_ok=True)
            _identify(folder, identity)
            self._file = Lines(folder / EVALUATIONS)
        except OSError as error:
            raise ExperimentError(f"--out: cannot write {folder} ({error.strerror})") from error

        for line in self._file.read():
            with suppress(ValueError):  # such a case is evaluated again
                evaluation = Evaluation.of(line)
                self._by_key[evaluation.key] = evaluation

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()

    def of(
        self, problem: SearchProblem, candidates: Sequence[Candidate], fly: Fly
    ) -> list[Evaluation]:
        """Return the evaluations of candidates, flying those that are missing."""
        keys = [problem.key(candidate) for candidate in candidates]
        missing = {
            key: candidate
            for key, candidate in zip(keys, candidates, strict=True)
            if key not in self._by_key
        }
        for evaluation in fly(problem, list(missing.values())):
            if self._file is not None:
                self._file.add(orjson.dumps(asdict(evaluation)))
            self._by_key[evaluation.key] = evaluation

        return [self._by_key[key] for key in keys]


def _identify(folder: Path, identity: dict[str, Any]) -> None:
    """Note the search in its folder, or check that the folder belongs to it."""
    file = folder / _IDENTITY
    text = orjson.dumps(identity, option=orjson.OPT_SORT_KEYS | orjson.OPT_INDENT_2)
    content = {path.name for path in folder.iterdir()}
    if content <= {_IDENTITY + PARTIAL}:  # nothing, or the part that a kill has left
        write_whole(file, text)
    elif not file.exists() or file.read_bytes() != text:
        raise refused("--out", "a new folder, or one of the same search", str(folder))


class Progress(Protocol):
    """Display of a search while it runs."""

    def simulated(self) -> None:
        """Count a run, whose evaluation may wait for those of its batch."""

    def show(self, case: SearchCase) -> None:
        """Tell a case and its evaluation."""

    def shrinking(self, candidate: Candidate, evaluations: int) -> None:
        """Tell the minimal case so far, and how many evaluations it took."""


def _counted(fly: Fly, progress: Progress) -> Fly:
    """Return a function that flies, and tells each run at once."""

    def counted(problem: SearchProblem, candidates: Sequence[Candidate]) -> Iterator[Evaluation]:
        for evaluation in fly(problem, candidates):
            progress.simulated()
            yield evaluation

    return counted


def flying(workers: Workers) -> Fly:
    """Return a function that flies candidates in worker processes."""

    def fly(problem: SearchProblem, candidates: Sequence[Candidate]) -> Iterator[Evaluation]:
        return workers.map(problem.evaluate, candidates)

    return fly


@dataclass(frozen=True, slots=True, kw_only=True)
class Search:
    """A search over a space for a problem."""

    problem: SearchProblem
    space: Space
    budget: int  # cases to evaluate, at least one
    seed: int = 0
    until_failure: bool = False  # end with the first batch that has a failure

    def __post_init__(self) -> None:
        if self.budget < 1:
            raise refused("budget", "a number >= 1", self.budget)

    def run(
        self, evaluations: Evaluations, fly: Fly, progress: Progress, at_once: int = 1
    ) -> SearchResult:
        """Evaluate the cases of the budget, then shrink the worst one if it has failed.

        at_once: cases that shrinking flies at a time, by which the result does not change.

        Raises: ScenarioError: the scenario fails without any event, or refuses all cases.
        """
        nothing = Candidate(())
        without_events = evaluations.of(self.problem, [nothing], fly)[0]

        if without_events.outcome == REFUSED:
            text = f"expected a scenario that can be flown, got {without_events.reason}"
            raise ScenarioError(self.problem.base.source, "", text)
        if without_events.failed:
            words = self.problem.objective.in_words(without_events.value)
            text = f"expected a scenario that holds its limit without events, got {words}"
            raise ScenarioError(self.problem.base.source, "", text)

        fly = _counted(fly, progress)
        cases = list(self._cases(evaluations, fly, progress))
        _check_simulated(cases)
        worst = min(cases, key=lambda case: case.order)
        minimal = None
        if worst.evaluation.failed:

            def evaluate(
                problem: SearchProblem, candidates: Sequence[Candidate]
            ) -> list[Evaluation]:
                return evaluations.of(problem, candidates, fly)

            shrinker = Shrinker(
                self.problem, worst.candidate, evaluate, progress.shrinking, at_once=at_once
            )
            shrinker.run()
            minimal = self._minimal(shrinker, evaluate)

        return SearchResult(
            problem=self.problem, without_events=without_events, cases=cases, minimal=minimal
        )

    def _minimal(self, shrinker: Shrinker, evaluate: Evaluate) -> Minimal:
        """Return the result of a shrinking that has ended."""
        problem, candidate = shrinker.problem, shrinker.candidate
        return Minimal(
            problem=problem,
            whole_team=len(self.problem.base.scenario.system.uav),
            candidate=candidate,
            evaluation=evaluate(problem, [candidate])[0],
            verdict=shrinker.verdict,
        )

    def _cases(
        self, evaluations: Evaluations, fly: Fly, progress: Progress
    ) -> Iterator[SearchCase]:
        """Yield the cases of the budget, in whole batches.

        The optimiser is told all points that it has been asked for, so the last batch is evaluated
        even if it goes beyond the budget.
        """
        optimiser = Optimiser(self.space.layout, seed=self.seed)
        number = 0

        while number < self.budget:
            points = optimiser.ask(BATCH if self.until_failure else self.budget - number)
            candidates = [self.space.candidate(point) for point in points]
            results = evaluations.of(self.problem, candidates, fly)
            optimiser.tell(points, [result.robustness for result in results])
            failed = False
            for candidate, evaluation in zip(candidates, results, strict=True):
                number += 1
                case = SearchCase(number=number, candidate=candidate, evaluation=evaluation)
                progress.show(case)
                yield case
                failed = failed or evaluation.failed
            if failed and self.until_failure:
                return


def _check_simulated(cases: Sequence[SearchCase]) -> None:
    """Refuse a space of which the scenario refuses every case."""
    if all(case.evaluation.outcome == REFUSED for case in cases):
        text = f"expected cases that can be flown, got {len(cases)} refused"
        first = cases[0].evaluation.reason
        raise ScenarioError("bounds", "", f"{text}, the first by {first}")


def random_search(search: Search, evaluations: Evaluations, fly: Fly) -> Iterator[SearchCase]:
    """Yield the cases of plain random search with the same budget: what a search has to beat."""
    rng = np.random.default_rng(search.seed)

    for first in range(0, search.budget, BATCH):
        points = rng.random((BATCH, search.space.dimension))
        candidates = [search.space.candidate(point) for point in points]
        results = evaluations.of(search.problem, candidates, fly)
        for number, pair in enumerate(zip(candidates, results, strict=True), first + 1):
            yield SearchCase(number=number, candidate=pair[0], evaluation=pair[1])
