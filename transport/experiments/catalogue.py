"""The experiments: what each changes from flight to flight, and what is refused."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeVar

from transport.experiments.cases import Point, Team
from transport.experiments.errors import refused

T = TypeVar("T", str, float)

NEVER, NOBODY = "never", "none"

# Who decides for whom, by UAVs per agent; None: one agent for all.
OWNERSHIPS: Mapping[str, int | None] = {"distributed": 1, "pairs": 2, "centralized": None}
CENTRALIZED = "centralized"

# Teams of these sizes are flown below the largest that is asked for. Beyond 16 UAVs a tick of the centralized
# team takes most of a second.
SIZES, QUICK_SIZES = (2, 3, 4, 6, 8, 10, 12, 16), (2, 4, 6)
LARGEST_TEAM = 16

# Standard deviation of one unit of `links.jitter_s`, and the mean it adds, by distribution (docs/scenario.md).
# A lognormal number whose logarithm has unit variance has a mean of 1 / sqrt(e - 1) standard deviations.
JITTER = {
    "uniform": (1.0 / math.sqrt(12.0), 0.0),
    "normal": (1.0, 0.0),
    "exponential": (1.0, 1.0),
    "lognormal": (1.0, 1.0 / math.sqrt(math.e - 1.0)),
}

# The smallest mean of a delay of each distribution whose random part is never cut off at zero, in standard
# deviations; the normal distribution has no such mean, 2 cut off 2 %.
SMALLEST_MEAN = {"uniform": math.sqrt(3.0), "normal": 2.0, "exponential": 1.0, "lognormal": JITTER["lognormal"][1]}


@dataclass(frozen=True, slots=True)
class Axis:
    """The column that a figure has along an axis.

    Attributes:
        label: Name of the column.
        title: With the unit.
        factor: From the column to that unit.
    """

    label: str
    title: str
    factor: float = 1.0


DELAY_AXIS, LOSS_AXIS = Axis("delay_s", "delay (ms)", 1e3), Axis("loss", "loss of plans (%)", 100.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """A sweep and how it is drawn.

    Attributes:
        name: Of the command.
        points: What is flown.
        x: Along the horizontal axis.
        y: Along the vertical axis of a map.
        drawn_as: Curves, a map, the growth of a team, a row for each variant, or cost against messages.
        curves: Column that tells the curves of a scenario from each other; points with "none" in it belong to all.
        legend: What its values are called in the figure.
        timed: Whether computation and messages are measured as well.
    """

    name: str
    points: tuple[Point, ...]
    x: Axis
    y: Axis | None = None
    drawn_as: Literal["curves", "map", "growth", "variants", "tradeoff"] = "curves"
    curves: str | None = None
    legend: Mapping[str | float, str] = field(default_factory=dict)
    timed: bool = False


def latency(scenarios: Sequence[str], delays_s: Sequence[float]) -> Experiment:
    """A fixed delay of every plan."""
    check_numbers("--delay", delays_s, "a delay >= 0 s", 0.0, math.inf)
    points = [
        Point(
            scenario=scenario,
            labels={"delay_s": delay_s},
            text=_ms(delay_s),
            settings=(f"links.delay_s={delay_s!r}",),
            baseline=delay_s == 0.0,
        )
        for scenario in distinct("--scenario", scenarios)
        for delay_s in sorted({0.0, *distinct("--delay", delays_s)})
    ]
    return Experiment(name="latency", points=tuple(points), x=DELAY_AXIS)


def loss(scenarios: Sequence[str], shares: Sequence[float], burst_ticks: float) -> Experiment:
    """Plans lost independently of each other, and the same share of them lost in bursts (Gilbert-Elliott).

    Args:
        scenarios: What is flown.
        shares: Of lost plans, on average.
        burst_ticks: Mean length of a burst, in which everything is lost, ticks.
    """
    check_numbers("--loss", shares, "a share from 0 to below 1", 0.0, 1.0)
    check_numbers("--burst", [burst_ticks], "a mean length >= 1 tick", 1.0, math.inf)
    some = sorted(share for share in distinct("--loss", shares) if share > 0.0)
    alone = {share: f"links.loss={share!r}" for share in some}
    bursts = {share: _bursts(share, burst_ticks) for share in some}
    points: list[Point] = []
    for scenario in distinct("--scenario", scenarios):
        points.append(
            Point(
                scenario=scenario,
                labels={"model": NOBODY, "loss": 0.0},
                text="no loss",
                settings=("links.loss=0.0",),
                baseline=True,
            )
        )
        points += [
            Point(
                scenario=scenario,
                labels={"model": model, "loss": share},
                text=f"{_percent(share)} {how}",
                settings=(setting,),
            )
            for model, how, settings in (("bernoulli", "at random", alone), ("bursts", "in bursts", bursts))
            for share, setting in settings.items()
        ]
    legend: dict[str | float, str] = {"bernoulli": "each on its own", "bursts": f"in bursts of {burst_ticks:g} ticks"}
    return Experiment(name="loss", points=tuple(points), x=LOSS_AXIS, curves="model", legend=legend)


def jitter(
    scenarios: Sequence[str], distributions: Sequence[str], deviations_s: Sequence[float], mean_s: float
) -> Experiment:
    """Random delays of different distributions, all of the same mean and standard deviation.

    Args:
        scenarios: What is flown.
        distributions: Of the delays.
        deviations_s: Standard deviations of the delay, s.
        mean_s: Mean delay, s.
    """
    for distribution in distributions:
        if distribution not in JITTER:
            raise refused("--distribution", f"one of {', '.join(JITTER)}", distribution)
    check_numbers("--mean", [mean_s], "a delay >= 0 s", 0.0, math.inf)
    for distribution in distinct("--distribution", distributions):
        largest_s = mean_s / SMALLEST_MEAN[distribution]
        expected = f"a standard deviation from 0 to {largest_s:.3g} s ({distribution}, mean {mean_s:g} s)"
        check_numbers("--std", deviations_s, expected, 0.0, math.nextafter(largest_s, math.inf))
    points: list[Point] = []
    for scenario in distinct("--scenario", scenarios):
        points += [
            Point(
                scenario=scenario,
                labels={"distribution": NOBODY, "std_s": 0.0, "mean_s": delay_s},
                text=f"constant {_ms(delay_s)}" if delay_s else "no delay",
                settings=(f"links.delay_s={delay_s!r}",),
                baseline=delay_s == 0.0,
            )
            for delay_s in dict.fromkeys((0.0, mean_s))
        ]
        for distribution in distributions:
            unit, mean_of_unit = JITTER[distribution]
            for deviation_s in sorted(std_s for std_s in distinct("--std", deviations_s) if std_s > 0.0):
                scale_s = deviation_s / unit
                links = {"delay_s": mean_s - mean_of_unit * scale_s, "jitter_s": scale_s}
                points.append(
                    Point(
                        scenario=scenario,
                        labels={"distribution": distribution, "std_s": deviation_s, "mean_s": mean_s},
                        text=f"{distribution} with {_ms(deviation_s)}",
                        settings=(
                            *(f"links.{key}={max(0.0, value)!r}" for key, value in links.items()),
                            f"links.distribution={distribution}",
                        ),
                    )
                )
    axis = Axis("std_s", "jitter, std (ms)", 1e3)
    return Experiment(name="jitter", points=tuple(points), x=axis, curves="distribution")


def kill(agents: Mapping[str, int], kill_s: float, restart_s: float) -> Experiment:
    """Each agent in turn is killed, and comes back or does not.

    Args:
        agents: Number of agents of each scenario that is flown.
        kill_s: When the agent is killed, scenario time.
        restart_s: When it is started again.
    """
    check_numbers("--at", [kill_s], "a time >= 0 s", 0.0, math.inf)
    if not kill_s < restart_s < math.inf:
        raise refused("--restart", f"a time after --at {kill_s:g} s", f"{restart_s:g}")
    points: list[Point] = []
    for scenario, count in agents.items():
        continued = "clock.on_agent_loss=continue"
        points.append(
            Point(
                scenario=scenario,
                labels={"agent": NOBODY, "restart_s": NOBODY},
                text="nobody killed",
                settings=(continued,),
                baseline=True,
            )
        )
        for back_s in (restart_s, None):
            for number in range(1, count + 1):
                agent = f"agent{number}"
                events = [(kill_s, "kill")] + ([] if back_s is None else [(back_s, "restart")])
                script = ",".join(f'{{at_s={at_s!r},do="{do}",target="{agent}"}}' for at_s, do in events)
                points.append(
                    Point(
                        scenario=scenario,
                        labels={"agent": str(number), "restart_s": NEVER if back_s is None else back_s},
                        text=f"{agent} {'gone for good' if back_s is None else f'back after {back_s - kill_s:g} s'}",
                        settings=(continued, f"faults.event=[{script}]"),
                    )
                )
    legend: dict[str | float, str] = {restart_s: f"started again at {restart_s:g} s", NEVER: "not started again"}
    axis = Axis("agent", f"agent killed at {kill_s:g} s")
    return Experiment(name="kill", points=tuple(points), x=axis, curves="restart_s", legend=legend)


def matrix(scenarios: Sequence[str], delays_s: Sequence[float], shares: Sequence[float]) -> Experiment:
    """Every delay with every loss."""
    check_numbers("--delay", delays_s, "a delay >= 0 s", 0.0, math.inf)
    check_numbers("--loss", shares, "a share from 0 to 1", 0.0, math.nextafter(1.0, 2.0))
    points = [
        Point(
            scenario=scenario,
            labels={"delay_s": delay_s, "loss": share},
            text=f"{_ms(delay_s)} and {_percent(share)} loss",
            settings=(f"links.delay_s={delay_s!r}", f"links.loss={share!r}"),
            baseline=delay_s == share == 0.0,
        )
        for scenario in distinct("--scenario", scenarios)
        for delay_s in sorted({0.0, *distinct("--delay", delays_s)})
        for share in sorted({0.0, *distinct("--loss", shares)})
    ]
    return Experiment(name="matrix", points=tuple(points), x=DELAY_AXIS, y=LOSS_AXIS, drawn_as="map")


def scaling(scenario: str, largest: int, sizes: Sequence[int]) -> Experiment:
    """Teams of more and more UAVs, each with an agent for every UAV, for every pair and for all.

    Args:
        scenario: What all is taken from but the team.
        largest: UAVs of the largest team.
        sizes: Of the teams below it.
    """
    if not 2 <= largest <= LARGEST_TEAM:
        raise refused("--max", f"a number of UAVs from 2 to {LARGEST_TEAM}", largest)
    points = []
    for ownership, group in OWNERSHIPS.items():
        for uavs in [*(size for size in sizes if size < largest), largest]:
            if group == 2 and (uavs == 2 or uavs % 2):
                continue  # a single pair is the centralized team, and of an odd number one is left over
            own = group or uavs
            points.append(
                Point(
                    scenario=scenario,
                    labels={"ownership": ownership, "uavs": uavs, "agents": uavs // own},
                    text=f"{uavs} UAVs {ownership}",
                    baseline=ownership == CENTRALIZED,
                    team=Team(uavs, own),
                )
            )
    axis = Axis("uavs", "UAVs")
    return Experiment(name="scaling", points=tuple(points), x=axis, drawn_as="growth", curves="ownership", timed=True)


def _bursts(share: float, burst_ticks: float) -> str:
    """Setting of a link that is bad, and then loses everything, for a share of the ticks in the long run."""
    leave = 1.0 / burst_ticks
    enter = leave * share / (1.0 - share)  # from share = enter / (enter + leave)
    if enter > 1.0:
        expected = f"at most {burst_ticks / (1.0 + burst_ticks):.3g} with bursts of {burst_ticks:g} ticks on average"
        raise refused("--loss", expected, f"{share:g}")
    return f"links.gilbert_elliott={{enter={enter!r},leave={leave!r},loss=1.0}}"


def check_numbers(option: str, values: Sequence[float], expected: str, low: float, below: float) -> None:
    """Refuse numbers of an option outside [low, below).

    Raises: ExperimentError: with the option, what was expected and what came.
    """
    for value in values:
        if not low <= value < below:
            raise refused(option, expected, f"{value:g}")


def distinct(option: str, values: Sequence[T]) -> Sequence[T]:
    """The values of an option.

    Raises: ExperimentError: one of them is there twice.
    """
    for value in values:
        if values.count(value) > 1:
            raise refused(option, "each value once", f"{value} {values.count(value)} times")
    return values


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:g} ms"


def _percent(share: float) -> str:
    return f"{100.0 * share:g} %"
