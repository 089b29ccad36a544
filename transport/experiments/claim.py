"""The paper's comparison: centralized against distributed control, at the same rate and at the same computation."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import orjson

from protocol.scenario_file import ScenarioError, find_scenario, read_scenario
from protocol.setup import Setup
from transport.experiments.cases import Case, Point
from transport.experiments.catalogue import Axis, Experiment
from transport.experiments.computation import (
    MANEUVER,
    QUICK_MANEUVER,
    REPEATS,
    Load,
    compared,
    equal_period_s,
    faster_and_faster,
)
from transport.experiments.errors import refused
from transport.experiments.flight import ERROR, Result
from transport.experiments.statistics import Estimate, estimate
from transport.report import write_whole

NAME = "paper"
CENTRALIZED, AS_PRINTED, CLOSED_LOOP = "centralized", "as printed", "closed loop"
SCENARIOS = {CENTRALIZED: "centralized", AS_PRINTED: "paper", CLOSED_LOOP: "resilient"}
REFERENCE, SAME_RATE, ONE_PROCESSOR, ONE_EACH = "reference", "same rate", "one processor", "one each"
STEPS, SECONDS = "steps", "seconds"
STILL, GUSTS = "still air", "gusts"

# Which horizons are flown of which controller. With so few seconds as equal steps leave it, nobody needs the other.
_KEPT = ((AS_PRINTED, STEPS), (AS_PRINTED, SECONDS), (CLOSED_LOOP, SECONDS))

_BUDGETS = {
    SAME_RATE: "same rate",
    ONE_PROCESSOR: "same computation on one processor",
    ONE_EACH: "same computation each",
}

_COMPUTATION = "computation.json"

# Up to which difference of the mean cost something is slightly better or worse, and from which on much.
_SLIGHT, _MUCH = 0.1, 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One line of the comparison.

    Attributes:
        controller: Centralized, as printed, closed loop.
        budget: What it has in common with the centralized one: rate, or computation on one processor or one each.
        kept: Of the centralized one's horizon.
        period_s: T_s.
        horizon: N_p.
    """

    controller: str
    budget: str
    kept: str
    period_s: float
    horizon: int


def computation(
    folder: Path, settings: Sequence[str], reference: Setup, *, quick: bool, notify: Callable[[str], None]
) -> list[Load]:
    """Measure what each distributed controller computes at shorter and shorter periods; once for each folder.

    Args:
        folder: Of the experiment: what was measured when it was begun is what it goes on with.
        settings: Changes of every scenario.
        reference: The centralized flight.
        quick: Measure once, on the shortest of flights.
        notify: Called with a line on what was measured.
    Raises: ExperimentError: the folder was begun with other settings.
    """
    maneuver, repeats = ([QUICK_MANEUVER], 1) if quick else ([MANEUVER], REPEATS)
    path, begun_with = folder / _COMPUTATION, [*settings, *maneuver]
    if path.exists():
        content = orjson.loads(path.read_bytes())
        if content["settings"] != begun_with:
            raise refused("--set", f"the settings {folder} was begun with, {content['settings']}", begun_with)
        return [Load(**entry) for entry in content["loads"]]
    central = setup_of(CENTRALIZED, [*settings, *maneuver])
    first = reference.settings
    loads = []
    for controller, kept in _KEPT:

        def load_at(period_s: float, controller: str = controller, kept: str = kept) -> Load:
            horizon = horizon_of(first.horizon, first.sampling_period_s, period_s, kept)
            candidate = setup_of(controller, [*settings, *maneuver, *at_rate(period_s, horizon)])
            return compared(central, candidate, controller, kept, repeats=repeats)

        for load in faster_and_faster(load_at, first.sampling_period_s):
            loads.append(load)
            notify(
                f"computation of {controller}, T_s {1e3 * load.period_s:.3g} ms, N_p {load.horizon}: "
                f"{load.step_ms:.2f} ms a step; x{load.one_each:.2f} of centralized, team x{load.one_processor:.2f}"
            )
    write_whole(path, orjson.dumps({"settings": begun_with, "loads": [asdict(load) for load in loads]}) + b"\n")
    return loads


def setup_of(controller: str, settings: Sequence[str]) -> Setup:
    """The flight of a controller.

    Raises: ScenarioError: settings that it cannot have.
    """
    path = find_scenario(SCENARIOS[controller])
    return Setup.of(read_scenario(path, settings), str(path))


def reference_of(settings: Sequence[str]) -> Setup:
    """The centralized flight that all are compared to.

    Raises: ScenarioError: settings under which the comparison makes no sense.
    """
    reference = setup_of(CENTRALIZED, settings)
    if len(reference.agents) > 1:
        source = str(find_scenario(SCENARIOS[CENTRALIZED]))
        raise ScenarioError(source, "agents.owned", f"expected one agent that owns all, got {len(reference.agents)}")
    return reference


def horizon_of(steps: int, period_s: float, own_period_s: float, kept: str) -> int:
    """N_p at another sampling period: as many steps, or steps for as many seconds."""
    return steps if kept == STEPS else max(1, round(steps * period_s / own_period_s))


def at_rate(period_s: float, horizon: int) -> tuple[str, ...]:
    """Settings of a sampling period and a horizon; the plant never steps further than that."""
    rate = f"controller.sampling_period_s={period_s!r}", f"controller.horizon={horizon}"
    return (*rate, *([f"plant.step_s={period_s!r}"] if period_s < 0.01 else []))


def rows(first_period_s: float, first_horizon: int, loads: Sequence[Load]) -> list[Row]:
    """What is flown: the centralized controller, then each other at its rate and at its computation."""

    def row(controller: str, budget: str, kept: str, period_s: float) -> Row:
        horizon = horizon_of(first_horizon, first_period_s, period_s, kept)
        return Row(controller=controller, budget=budget, kept=kept, period_s=period_s, horizon=horizon)

    found = [row(CENTRALIZED, REFERENCE, STEPS, first_period_s)]
    for controller in (AS_PRINTED, CLOSED_LOOP):
        found.append(row(controller, SAME_RATE, STEPS, first_period_s))
        for budget in (ONE_PROCESSOR, ONE_EACH):
            for kept in (kept for who, kept in _KEPT if who == controller):
                measured = [load for load in loads if (load.controller, load.kept) == (controller, kept)]
                period_s = equal_period_s(measured, budget)
                if period_s is not None:
                    found.append(row(controller, budget, kept, period_s))
    return found


def experiment(flown: Sequence[Row], gust_mps: float) -> Experiment:
    """The sweep: every row in still air and in gusts."""
    weathers = {STILL: "plant.wind.gust_mps=[0.0,0.0,0.0]"}
    if gust_mps > 0.0:
        weathers[GUSTS] = f"plant.wind.gust_mps=[{gust_mps!r},{gust_mps!r},{gust_mps!r}]"
    points = [
        Point(
            scenario=SCENARIOS[row.controller],
            labels={"weather": weather, **asdict(row)},
            text=f"{row.controller}, {row.budget}, {weather}",
            settings=(*at_rate(row.period_s, row.horizon), setting),
            baseline=row.controller == CENTRALIZED,
        )
        for weather, setting in weathers.items()
        for row in flown
    ]
    return Experiment(name=NAME, points=tuple(points), x=Axis("period_s", "T_s (ms)", 1e3), timed=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class Compared:
    """A row in one weather, against the centralized controller.

    Attributes:
        row: The row.
        weather: Still air or gusts.
        flights: How many were flown; those that could not be are not among them.
        lost_s: When those that were not completed ended, ascending.
        numbers: Means over the completed flights, by name (flight.NUMBERS, effort.EFFORT).
        ratios: Means of the same over the centralized flight's of the same seed.
    """

    row: Row
    weather: str
    flights: int
    lost_s: tuple[float, ...]
    numbers: Mapping[str, Estimate | None]
    ratios: Mapping[str, Estimate | None]

    @property
    def completed(self) -> int:
        """How many came to the end of the maneuver."""
        return self.flights - len(self.lost_s)


def compare(points: Sequence[Point], cases: Iterable[Case], results: Iterable[Result]) -> list[Compared]:
    """Every row against the centralized flights in the same weather: seed by seed, as it is the same wind.

    Args:
        points: Of the experiment.
        cases: Its flights.
        results: What came of each.
    """
    by_point: list[dict[int, Mapping[str, float | None]]] = [{} for _ in points]
    lost: list[list[float]] = [[] for _ in points]
    for case, result in zip(cases, results, strict=True):
        period_s = case.scenario.controller.sampling_period_s
        if result.outcome == "completed":
            by_point[case.point][case.scenario.seed] = result.numbers | _per_second(result.numbers, period_s)
        elif result.outcome != ERROR:
            lost[case.point].append(result.numbers["lost_s"] or 0.0)
    references = {
        point.labels["weather"]: found for point, found in zip(points, by_point, strict=True) if point.baseline
    }
    compared = []
    for point, found, lost_s in zip(points, by_point, lost, strict=True):
        labels: dict[str, Any] = dict(point.labels)
        weather = labels.pop("weather")
        names = list(dict.fromkeys(name for numbers in found.values() for name in numbers))
        compared.append(
            Compared(
                row=Row(**labels),
                weather=weather,
                flights=len(found) + len(lost_s),
                lost_s=tuple(sorted(lost_s)),
                numbers={name: _mean(numbers.get(name) for numbers in found.values()) for name in names},
                ratios={name: _ratio(name, found, references[weather]) for name in names},
            )
        )
    return compared


def _per_second(numbers: Mapping[str, float | None], period_s: float) -> dict[str, float | None]:
    """Computation of the team per second of flight, s/s."""
    tick_ms = numbers.get("cpu_team_tick_ms")
    return {"cpu_team_s_per_s": None if tick_ms is None else tick_ms / 1e3 / period_s}


def _ratio(
    name: str, found: Mapping[int, Mapping[str, float | None]], reference: Mapping[int, Mapping[str, float | None]]
) -> Estimate | None:
    pairs = [(numbers.get(name), reference[seed].get(name)) for seed, numbers in found.items() if seed in reference]
    return estimate([own / first for own, first in pairs if own is not None and first])


def _mean(values: Iterable[float | None]) -> Estimate | None:
    return estimate([value for value in values if value is not None])


def verdict(compared: Sequence[Compared]) -> list[str]:
    """What the numbers say, and what of the paper's two statements holds, in words that follow from nothing else."""
    lines = [_line(c) for c in compared if c.row.controller != CENTRALIZED]
    return [*lines, "", *_statements(compared)]


def _line(c: Compared) -> str:
    row = c.row
    who = f"{c.weather}, {row.controller}, {_BUDGETS[row.budget]}, {1e3 * row.period_s:g} ms x {row.horizon}"
    if not c.flights:
        return f"{who}: could not be flown"
    if c.lost_s:
        return f"{who}: {len(c.lost_s)} of {c.flights} flights lost, the first at {c.lost_s[0]:.1f} s"
    return f"{who}: cost {_times(c.ratios.get('cost_mean'))}, {judged(c)}; peak {_times(c.ratios.get('cost_max'))}"


def judged(c: Compared) -> str:
    """Whether a row is better or worse than the centralized controller, by its mean cost.

    A single flight is compared as it is; of several the 95 % confidence interval has to leave 1 out.
    """
    if c.completed < c.flights or c.flights == 0:
        return "lost"
    ratio = c.ratios.get("cost_mean")
    if ratio is None:
        return "not compared"
    margin = ratio.half_width or 0.0
    if abs(ratio.mean - 1.0) <= margin:
        return "no difference that can be told"
    share = abs(ratio.mean - 1.0)
    words = "slightly " if share <= _SLIGHT else "" if share <= _MUCH else "much "
    return words + ("worse" if ratio.mean > 1.0 else "better")


def _statements(compared: Sequence[Compared]) -> list[str]:
    """The paper's two statements, each against the rows it is about."""
    as_printed = [c for c in compared if c.row.controller == AS_PRINTED]
    lines = [_statement("slightly worse at the same rate", as_printed, SAME_RATE, STEPS, "worse")]
    for budget in (ONE_PROCESSOR, ONE_EACH):
        for kept in (STEPS, SECONDS):
            lines.append(_statement("slightly better at the same computation", as_printed, budget, kept, "better"))
    return lines


def _statement(text: str, compared: Sequence[Compared], budget: str, kept: str, word: str) -> str:
    rows = [c for c in compared if (c.row.budget, c.row.kept) == (budget, kept)]
    which = f'"{text}"' + ("" if budget == SAME_RATE else f", {_BUDGETS[budget]}, as many {kept} of horizon")
    if not rows:
        return f"{which}: no such rate, even at the centralized one's they compute more"
    holds = sum(judged(c).endswith(word) for c in rows)
    how = {0: "does not hold", len(rows): "holds"}.get(holds, "depends on the weather")
    where = ", ".join(f"{judged(c)} in {c.weather}" for c in rows)
    return f"{which}: {how} ({where})"


def _times(value: Estimate | None) -> str:
    if value is None:
        return "x?"
    return f"x{value.mean:.3f}" + ("" if value.half_width is None else f" ± {value.half_width:.3f}")
