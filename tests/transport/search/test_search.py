"""Searches: deterministic, resumed, better than chance, and minimal in what they hand over."""

import io
import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
import orjson
import pytest
from rich.console import Console

import transport
from tests.support import runs
from tests.support.logs import log_of
from tests.support.runs import SCENARIOS, SHORT, recorded
from transport.analysis.analysed_run import AnalysedRun
from transport.analysis.series import series_of
from transport.analysis.summary_assembly import summarise
from transport.experiments.cases import ExperimentError
from transport.interface.setting_arguments import ArgumentError, names_of
from transport.interface.worst_case import Worst
from transport.model import state
from transport.model.arrays import Array
from transport.protocol.scenario.scenario_file import read_scenario
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.scenario.setup.run_setup import Setup
from transport.search.candidate import Base, Candidate
from transport.search.evaluation import REFUSED, CaseVerdict, Evaluation, SearchProblem
from transport.search.kinds_of_events import Death, DrawnSilence, Gusts
from transport.search.objective import SearchObjective
from transport.search.optimiser import BATCH, Optimiser, SearchLayout
from transport.search.search import Evaluations, Search, SearchCase, SearchResult, random_search
from transport.search.search_progress import SearchProgress
from transport.search.search_report import summary
from transport.search.shrink import Shrinker
from transport.search.space import Space, read_bounds

FILE = SCENARIOS / "resilient.toml"
KINDS = ("silence", "deaths", "gusts")
WINDOW_S = (6.0, 7.0)  # the planted fault: a silence that begins here, while agent 3 is dead


class Quiet:
    """Progress without a display."""

    def simulated(self) -> None:
        """Tell nothing."""

    def show(self, case: SearchCase) -> None:
        """Tell nothing."""

    def shrinking(self, candidate: Candidate, evaluations: int) -> None:
        """Tell nothing."""


class Planted(SearchProblem):
    """A problem whose runs fail by a formula: a coincidence of a death and a silence."""

    def evaluate(self, candidate: Candidate) -> Evaluation:
        """Return a robustness that falls towards the coincidence."""
        silences = [event for event in candidate.events if isinstance(event, DrawnSilence)]
        deaths = [event for event in candidate.events if isinstance(event, Death)]
        begins = [abs(one.start_s - np.mean(WINDOW_S)) for one in silences]
        dead = any(death.agent == 3 and death.at_s < WINDOW_S[0] for death in deaths)
        away_s = min(begins, default=20.0) + (0.0 if dead else 10.0)
        robustness = min(1.0, (away_s - 0.5) / 20.0)
        has_failed = robustness < 0.0
        return Evaluation(
            key=self.key(candidate),
            robustness=float(robustness),
            value=math.inf if has_failed else 0.0,  # as of a run without the number
            outcome="failed" if has_failed else "completed",
            end_s=0.0,
        )

    def with_perfect_information(self, candidate: Candidate) -> Evaluation:
        """Return that the centralized controller survives."""
        return self.evaluate(Candidate(()))


class SmallTeamsFail(Planted):
    """The same, where teams of less than four fail without any event."""

    def evaluate(self, candidate: Candidate) -> Evaluation:
        """Return the planted robustness, or the failure of a small team."""
        found = super().evaluate(candidate)
        if len(self.base.scenario.owned) == 4:
            return found
        return replace(found, robustness=-0.1, outcome="failed")


@dataclass(frozen=True, kw_only=True)
class SmallTeamsBeyondPhysics(Planted):
    """The same, where perfect information does not save teams of less than four."""

    verdicts: list[int] = field(default_factory=list)  # sizes of the teams with it

    def with_perfect_information(self, candidate: Candidate) -> Evaluation:
        """Return that the centralized controller survives with the whole team alone."""
        if candidate.events:
            self.verdicts.append(len(self.base.scenario.owned))
        if len(self.base.scenario.owned) == 4 or not candidate.events:
            return super().with_perfect_information(candidate)
        return self.evaluate(candidate)


def planted() -> Planted:
    """Return the planted problem on the ready scenario."""
    scenario = read_scenario(FILE)
    base = Base(scenario=scenario, source=str(FILE))
    return Planted(base=base, objective=SearchObjective.of("attitude", None, scenario))


def fly(problem: SearchProblem, candidates: Sequence[Candidate]) -> Iterable[Evaluation]:
    """Evaluate in this process."""
    return [problem.evaluate(candidate) for candidate in candidates]


def backwards(problem: SearchProblem, candidates: Sequence[Candidate]) -> Iterable[Evaluation]:
    """Evaluate in another order, as workers of different speed do."""
    return [problem.evaluate(candidate) for candidate in reversed(candidates)]


def search(budget: int, seed: int = 0, *, until_failure: bool = False) -> Search:
    """Return a search for the planted coincidence."""
    problem = planted()
    space = Space(KINDS, read_bounds(None, 25.0), problem.base.scenario)
    return Search(
        problem=problem, space=space, budget=budget, seed=seed, until_failure=until_failure
    )


def test_a_search_does_not_depend_on_the_order_of_results() -> None:
    """Workers of any speed give the same cases, the same worst and the same minimal one."""
    one = search(160).run(Evaluations(None, {}), fly, Quiet())
    other = search(160).run(Evaluations(None, {}), backwards, Quiet())
    assert one == other


def test_a_search_that_was_killed_gives_the_result_of_one_that_was_not(tmp_path: Path) -> None:
    """What was evaluated before the kill is not flown again, a cut line of the file excepted."""
    flown_in_whole, counting = counted()
    whole = search(160).run(Evaluations(None, {}), counting, Quiet())
    first = Evaluations(tmp_path / "out", {"seed": 0})
    search(80).run(first, fly, Quiet())
    first.close()
    file = tmp_path / "out" / "evaluations.jsonl"
    file.write_bytes(file.read_bytes()[:-20])
    kept = {json.loads(line)["key"] for line in file.read_bytes().splitlines()[:-1]}

    flown, counting = counted()
    second = Evaluations(tmp_path / "out", {"seed": 0})
    resumed = search(160).run(second, counting, Quiet())
    second.close()
    assert resumed == whole
    assert set(flown) == set(flown_in_whole) - kept
    assert 0 < len(flown) < len(flown_in_whole)

    # The line that was cut takes none of the next ones with it.
    flown, counting = counted()
    third = Evaluations(tmp_path / "out", {"seed": 0})
    assert search(160).run(third, counting, Quiet()) == whole
    third.close()
    assert flown == []


def test_a_minimal_case_fails_by_its_events() -> None:
    """A smaller team that fails without them is no simpler case of theirs."""
    whole = search(160)
    in_weather = SmallTeamsFail(base=whole.problem.base, objective=whole.problem.objective)
    minimal = replace(whole, problem=in_weather).run(Evaluations(None, {}), fly, Quiet()).minimal
    assert minimal is not None
    assert len(minimal.problem.base.scenario.owned) == 4
    assert not in_weather.evaluate(Candidate(())).failed

    held = whole.run(Evaluations(None, {}), fly, Quiet()).minimal
    assert held is not None
    assert len(held.problem.base.scenario.owned) < 4
    assert held.whole_team == 4
    assert held.evaluation.key == held.problem.key(held.candidate)


def test_a_minimal_case_keeps_the_verdict_of_the_whole_team() -> None:
    """A smaller team that perfect information does not save is not the case of the whole one.

    The verdict is simulated once for each team. The events name agent 3, so the smallest has three.
    """
    whole = search(160)
    problem = SmallTeamsBeyondPhysics(base=whole.problem.base, objective=whole.problem.objective)
    minimal = replace(whole, problem=problem).run(Evaluations(None, {}), fly, Quiet()).minimal
    assert minimal is not None
    assert len(minimal.problem.base.scenario.owned) == 4
    assert minimal.verdict.beyond_physics is False
    assert problem.verdicts == [4, 3]


@dataclass(frozen=True, kw_only=True)
class Refusing(Planted):
    """A problem whose scenario refuses silences that begin before a time."""

    earliest_s: float

    def evaluate(self, candidate: Candidate) -> Evaluation:
        """Return the planted robustness, or a refusal."""
        evaluation = super().evaluate(candidate)
        silences = [event for event in candidate.events if isinstance(event, DrawnSilence)]
        if all(silence.start_s >= self.earliest_s for silence in silences):
            return evaluation
        return replace(evaluation, robustness=1.0, outcome=REFUSED, reason="links: too early")


def test_refused_cases_are_counted_and_a_space_without_others_is_refused() -> None:
    """No case of such a space says that the team holds."""
    whole = search(32)
    base, objective = whole.problem.base, whole.problem.objective
    some = Refusing(base=base, objective=objective, earliest_s=8.0)
    result = replace(whole, problem=some).run(Evaluations(None, {}), fly, Quiet())
    assert 0 < len(result.refused) < len(result.cases)
    assert summary(result)["refused"] == len(result.refused)

    refused = replace(some.evaluate(Candidate(())), outcome=REFUSED, reason="links: none")
    with pytest.raises(
        ScenarioError, match="expected a scenario that can be flown, got links: non"
    ):
        whole.run(Evaluations(None, {}), lambda *_: [refused], Quiet())

    every = Refusing(base=base, objective=objective, earliest_s=30.0)
    silences = Space(("silence",), read_bounds(None, 25.0), base.scenario)
    without_others = replace(whole, problem=every, space=silences)
    with pytest.raises(ScenarioError, match="refused, the first by links: too early"):
        without_others.run(Evaluations(None, {}), fly, Quiet())


@pytest.mark.parametrize(
    ("measure", "limit", "passed_s"),
    [
        ("payload", 0.2, 0.3),
        ("separation", 0.45, 0.1),
        ("cost", 1e-9, None),
        ("payload", 9.0, None),
    ],
)
def test_the_time_of_a_failure_is_that_of_the_limit(
    measure: str, limit: float, passed_s: float | None
) -> None:
    """A payload that leaves its reference at 1 m/s, and UAVs that are closer from 0.1 s on."""
    run = runs.setup(SHORT)
    flown = series_of(run, log_of([runs.plant_state(run, k) for k in range(8)]))
    away_m = np.clip(flown.times_s - 0.1 + 1e-9, 0.0, None)
    series = replace(
        flown,
        payload_reference_I=flown.x[:, state.R0] - away_m[:, None] * [1.0, 0.0, 0.0],
        separation_m=np.where(flown.times_s > 0.1 - 1e-9, 0.4, 0.5),
    )
    objective = SearchObjective.of(measure, limit, run.scenario)
    assert objective.passed_s(series) == passed_s


def counted() -> tuple[list[str], Callable[..., Iterable[Evaluation]]]:
    """Return the keys of what is flown, to be filled, and a function that flies in this process."""
    keys: list[str] = []

    def counting(problem: SearchProblem, candidates: Sequence[Candidate]) -> Iterable[Evaluation]:
        keys.extend(problem.key(candidate) for candidate in candidates)
        return fly(problem, candidates)

    return keys, counting


def test_a_folder_of_another_search_is_refused(tmp_path: Path) -> None:
    """A search continues only one of the same scenario, space and seed."""
    Evaluations(tmp_path / "out", {"seed": 0}).close()
    with pytest.raises(ExperimentError, match="one of the same search"):
        Evaluations(tmp_path / "out", {"seed": 1})
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").touch()
    with pytest.raises(ExperimentError, match="one of the same search"):
        Evaluations(tmp_path / "other", {"seed": 0})


def test_a_folder_of_a_search_killed_at_its_start_is_new(tmp_path: Path) -> None:
    """The name of the search is in its folder as a whole or not at all; a part of it refuses nothing."""
    (tmp_path / "search.json.partial").write_bytes(b'{"see')
    Evaluations(tmp_path, {"seed": 1}).close()
    assert json.loads((tmp_path / "search.json").read_text()) == {"seed": 1}
    Evaluations(tmp_path, {"seed": 1}).close()


def test_lines_that_are_no_evaluations_are_skipped(tmp_path: Path) -> None:
    """A file of evaluations may have any other JSON; the evaluations after it are known."""
    Evaluations(tmp_path, {}).close()
    problem = planted()
    known = problem.evaluate(Candidate(()))
    tree = orjson.loads(orjson.dumps(asdict(known)))
    wrong = [{**tree, name: value} for name in tree for value in ([1], {"a": 1}, True)]
    others = [b"[1]", b"1", b"null", b"\xff", b'{"key": "a"}', b'{"other": 1}']
    lines = [*others, *map(orjson.dumps, [tree, *wrong])]
    (tmp_path / "evaluations.jsonl").write_bytes(b"\n".join(lines) + b"\n")
    flown, counting = counted()
    evaluations = Evaluations(tmp_path, {})
    assert evaluations.of(problem, [Candidate(())], counting) == [known]
    evaluations.close()
    assert flown == []


def cases_of(*robustness: float) -> SearchResult:
    """Return the result of a search whose cases have these values of robustness."""
    nothing = Candidate(())
    without_events = planted().evaluate(nothing)
    cases = [
        SearchCase(
            number=n, candidate=nothing, evaluation=replace(without_events, robustness=value)
        )
        for n, value in enumerate(robustness, start=1)
    ]
    return SearchResult(problem=planted(), without_events=without_events, cases=cases, minimal=None)


def test_the_worst_case_and_the_first_failure() -> None:
    """Of equal ones the first case is the worst, also in the table; only a failure is the first failure."""
    result = cases_of(0.5, -0.1, -0.4, -0.4, 0.2)
    assert result.worst.number == 3
    assert [row["case"] for row in summary(result)["worst"]] == [3, 4, 2, 5, 1]
    assert (result.first_failure, result.failures) == (2, 3)
    assert cases_of(0.5, 0.2).first_failure is None
    many = summary(cases_of(*np.linspace(1.0, -1.0, 12)))["worst"]
    assert [row["case"] for row in many] == list(range(12, 2, -1))  # ten of them


def test_a_search_until_a_failure_ends_with_its_batch() -> None:
    """Batches before the failure are not the last."""
    whole = search(400).run(Evaluations(None, {}), fly, Quiet())
    assert whole.first_failure is not None
    assert whole.first_failure > BATCH
    batches = math.ceil(whole.first_failure / BATCH)
    ended = search(400, until_failure=True).run(Evaluations(None, {}), fly, Quiet())
    assert ended.cases == whole.cases[: batches * BATCH]


def test_random_search_counts_its_cases() -> None:
    """Cases are numbered across batches, as in a search, whose number of runs they are compared with."""
    cases = list(random_search(search(3 * BATCH), Evaluations(None, {}), fly))
    assert [case.number for case in cases] == list(range(1, 3 * BATCH + 1))
    other = list(random_search(search(BATCH, seed=1), Evaluations(None, {}), fly))
    assert other[0].candidate != cases[0].candidate  # draws of its seed


def test_a_search_without_cases_is_refused() -> None:
    """The budget is at least one case."""
    with pytest.raises(ExperimentError, match="budget: expected a number >= 1, got 0"):
        search(0)


def test_the_minimal_case_has_the_two_events_of_the_coincidence() -> None:
    """Whatever else was drawn, shrinking leaves the death and the silence, with round numbers."""
    result = search(400).run(Evaluations(None, {}), fly, Quiet())
    assert result.minimal is not None
    kinds = sorted(type(event).__name__ for event in result.minimal.candidate.events)
    assert kinds == ["Death", "DrawnSilence"]
    death = next(event for event in result.minimal.candidate.events if isinstance(event, Death))
    assert 2.0 * death.at_s == round(2.0 * death.at_s)
    assert death.back_after_s is None
    assert result.minimal.verdict.beyond_physics is False


VALLEY = np.full(12, 0.3)


def asked(disturb: Callable[[], object] = lambda: None) -> Array:
    """Return the 160 points that an optimiser asks for on a smooth valley, (160, 12)."""
    layout = SearchLayout(events=(slice(0, 6), slice(6, 12)), severe=np.zeros(12, dtype=bool))
    optimiser = Optimiser(layout, seed=3)
    whole: list[Array] = []
    for _ in range(20):
        points = optimiser.ask()
        disturb()
        optimiser.tell(points, [depth(point) for point in points])
        whole += points
    return np.array(whole)


def depth(point: Array) -> float:
    """Return the squared distance from the lowest point of the valley."""
    return float(np.square(point - VALLEY).sum())


def test_the_optimiser_beats_chance() -> None:
    """On a smooth valley the best of 160 points is nearer than the best of 480 random ones."""
    random = np.random.default_rng(3).random((480, 12))
    assert min(map(depth, asked())) < min(map(depth, random))


def test_the_optimiser_shares_no_random_numbers() -> None:
    """A class of the user that draws from numpy's global generator changes no search, nor a search it."""
    np.random.seed(1)
    expected = np.random.rand(20)
    np.random.seed(1)
    drawn: list[float] = []
    points = asked(lambda: drawn.append(np.random.rand()))
    np.testing.assert_array_equal(points, asked())
    np.testing.assert_array_equal(drawn, expected)


def test_a_scenario_that_fails_without_events_is_refused() -> None:
    """A search needs a run that holds its limit; otherwise every case would be a finding."""
    problem = planted()
    limit = SearchObjective.of("separation", 10.0, problem.base.scenario)
    scenario = read_scenario(FILE, [SHORT])
    base = Base(scenario=scenario, source=str(FILE))
    failing = SearchProblem(base=base, objective=limit)
    space = Space(KINDS, read_bounds(None, 25.0), scenario)
    with pytest.raises(ScenarioError, match="holds its limit without events"):
        Search(problem=failing, space=space, budget=8).run(Evaluations(None, {}), fly, Quiet())


def test_own_constraints_count_as_violations_as_limits_do() -> None:
    """The objective is the largest of them: in the constraint's unit, of limits as a share."""
    own = 'controller.constraint=[{expression="v0[2] >= -0.05"}]'
    scenario = read_scenario(FILE, [SHORT, own])
    base = Base(scenario=scenario, source=str(FILE))
    objective = SearchObjective.of("constraint", 0.2, scenario)
    evaluation = SearchProblem(base=base, objective=objective).evaluate(Candidate(()))

    setup = Setup.of(scenario, str(FILE))
    summary = summarise(AnalysedRun.of(setup, log_of(recorded(setup))))
    violation = summary["own_constraints"][0]["violation_max"]
    assert violation > summary["constraint_violation_max"]
    assert evaluation.value == violation
    assert objective.value(summary | {"own_constraints": []}) < violation


def test_a_run_ends_as_soon_as_it_has_failed() -> None:
    """A run past the limit of attitude is not flown on; the end is the time of the failure."""
    scenario = read_scenario(FILE, [SHORT])
    base = Base(scenario=scenario, source=str(FILE))
    problem = SearchProblem(base=base, objective=SearchObjective.of("attitude", 0.005, scenario))
    evaluation = problem.evaluate(Candidate((Gusts(speed_mps=1.0, seed=1),)))
    assert evaluation.outcome == "failed"
    assert 0.0 < evaluation.end_s < 1.4
    assert evaluation.robustness == pytest.approx(evaluation.end_s / 1.5 - 1.0)


def test_python_takes_kinds_as_text_and_bounds_from_a_file() -> None:
    """Text is as on the command line; a mapping of bounds is refused by the argument's name."""
    assert names_of("silence, gusts") == names_of(["silence", "gusts"]) == ("silence", "gusts")
    with pytest.raises(ArgumentError, match="bounds: expected a TOML file, got dict"):
        transport.worst("resilient", bounds={})  # type: ignore[arg-type]  # the error of a user
    result = search(8).run(Evaluations(None, {}), fly, Quiet())
    assert repr(Worst(result)) == "<Worst: 8 cases, 0 of them fail>"


def test_a_search_without_a_terminal_tells_how_far_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """A line counts the runs of a batch as they end, also before the first case has its result."""
    monkeypatch.setattr("transport.flight.progress._LINE_EVERY_S", 0.0)
    budget = 2 * BATCH + 1  # flown are whole batches
    output = io.StringIO()
    console = Console(file=output, width=200)
    with SearchProgress(planted(), budget, console) as progress:
        search(budget).run(Evaluations(None, {}), fly, progress)
    lines = output.getvalue().splitlines()
    assert lines[0].startswith("1 of 24 cases")
    told = [int(line.partition(" of ")[0]) for line in lines if " of 24 cases" in line]
    assert told == list(range(1, 3 * BATCH + 1))


ONE_UAV = """
import numpy as np
class One:
    "A class for one UAV of four, which stops to stabilise it after a second."
    version = "1"
    def start(self, run):
        if len(run.owned) != 1 or run.system.N != 4:
            raise ValueError("one UAV of four for each agent")
        self.run = run
    def step(self, measurement, messages):
        uav = self.run.owned[0]
        state = measurement.uav_states[0]
        u = self.run.u_hover.reshape(-1, 4)[uav].copy()
        inertia = self.run.system.uavs[uav].inertia
        u[1:] = inertia @ (-100.0 * state[6:9] - 16.0 * state[9:12])
        if self.run.tick > 20 and len(self.run.agents) < 4:
            u[1:] = 0.5
        return u
    def stop(self):
        pass
"""


def own_class_problem(folder: Path, limit_deg: float) -> SearchProblem:
    """Return a hover of four UAVs with the class above."""
    (folder / "only_one.py").write_text(ONE_UAV, encoding="utf-8")
    hover = "maneuver.phase=[{name='hover',duration_s=2.0,displacement_m=[0.0,0.0,0.0]}]"
    scenario = read_scenario(FILE, [hover, "agents.controller=only_one:One"])
    base = Base(scenario=scenario, source=str(FILE))
    return SearchProblem(base=base, objective=SearchObjective.of("attitude", limit_deg, scenario))


def test_the_verdict_on_a_class_of_the_user_is_that_of_the_projects_controller(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A class for a single UAV cannot be the one agent for all; the project's controller is, and survives."""
    monkeypatch.chdir(tmp_path)
    problem = own_class_problem(tmp_path, limit_deg=5.0)
    death = Candidate((Death(agent=2, at_s=0.5),))
    assert problem.evaluate(death).failed
    assert problem.verdict(death) == CaseVerdict(beyond_physics=False)


def test_a_verdict_that_cannot_be_told_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A limit that the project's controller does not keep without any event tells nothing of the events."""
    monkeypatch.chdir(tmp_path)
    whole = own_class_problem(tmp_path, limit_deg=1e-3)
    leg = "maneuver.phase=[{name='leg',duration_s=2.0,displacement_m=[0.2,0.0,0.0]}]"
    scenario = read_scenario(FILE, [leg, "agents.controller=only_one:One"])
    problem = replace(whole, base=Base(scenario=scenario, source=str(FILE)))
    verdict = problem.verdict(Candidate((Gusts(speed_mps=0.5, seed=7),)))
    assert verdict.beyond_physics is None
    assert verdict.reason == "it fails without any event as well"


def test_a_class_that_refuses_a_smaller_team_does_not_end_the_search(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its case is refused, as one that the scenario refuses, and the minimal case keeps the whole team."""
    monkeypatch.chdir(tmp_path)
    problem = own_class_problem(tmp_path, limit_deg=5.0)
    smaller = replace(problem, base=problem.base.of_size(3))
    refused = smaller.evaluate(Candidate(()))
    assert refused.outcome == REFUSED
    assert "one UAV of four for each agent" in refused.reason

    shrinker = Shrinker(
        problem, Candidate((Death(agent=2, at_s=0.5),)), lambda *of: list(fly(*of)), lambda *_: None
    )
    shrinker.run()
    assert len(shrinker.problem.base.scenario.owned) == 4
    assert shrinker.verdict.beyond_physics is False
