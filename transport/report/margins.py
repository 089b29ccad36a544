"""Margins of a scenario's hover: differences of plant and model with which it is stable."""

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass

import numpy as np
import threadpoolctl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from transport.mpc.controller import Controller
from transport.mpc.margins import FARTHEST, FARTHEST_S, Loop, Margin, Mismatch, margins
from transport.mpc.reference import Sampled
from transport.protocol.scenario.errors import ScenarioError
from transport.protocol.scenario.setup import Setup
from transport.report.style import COLUMN_IN, CURVES

# Label and unit of each property of the plant; factors are relative to the value that the
# controllers know.
LABELS = {
    "lag_s": "motor lag, ms",
    "delay_s": "actuator delay, ms",
    "gain": "actuator gain",
    "uav_inertia": "UAV inertia",
    "uav_mass": "UAV mass",
    "payload_mass": "payload mass",
    "payload_inertia": "payload inertia",
    "rod_length": "rod length",
}
ACTUATIONS = ("immediate", "next_tick")
_FEEDBACK = "closed_loop, riccati, exact"  # prediction, terminal and discretisation
# Tolerance of a delay in periods: a time over the sampling period has rounding errors.
_ROUNDING = 1e-9
_MS_PER_S = 1e3
_HEIGHT_IN = 1.5
# Height of a bar, and distance of those of one property, as shares of the property's place.
_BAR = 0.32
_APART = 0.36


@dataclass(frozen=True, slots=True, kw_only=True)
class HoverMargins:
    """Result of the analysis, for both values of `clock.actuation`.

    The plant is as the controllers know it but for `margins`.
    """

    scenario: str
    without: tuple[int, ...]  # agents that are gone, 1-based, whose UAVs follow the fail-safe
    # Time in which the slowest deviation decays by e; None: the payload is not held.
    settling_s: dict[str, float | None]
    growth_per_s: dict[str, float]  # of the fastest growing mode
    # Margins of the properties of `mpc.margins.Mismatch`; none where it is unstable.
    margins: dict[str, dict[str, Margin]]


def hover_margins(setup: Setup, without: Collection[int] = ()) -> HoverMargins:
    """Return the margins of a scenario about hover, with the fixed delay of its links.

    The agents in `without`, 1-based, are gone. Agents know each other's state one sampling period
    late, or as late as `links.delay_s`. Limits, constraints, packet loss and the disturbance
    estimate are not part of the analysis. Source: docs/equations.md (58).

    Raises: ScenarioError: plans are not the shared control law, or the agents that are gone not
        some of several.
    """
    absent = tuple(sorted(set(without)))
    _check(setup, absent)

    # Several threads are slower than one with matrices of this size.
    with threadpoolctl.threadpool_limits(1):
        loops = _loops(setup, absent)
        as_modelled = Mismatch(lag_s=setup.settings.motor_lag_s)
        return HoverMargins(
            scenario=setup.scenario.name,
            without=absent,
            settling_s={name: loop.settling_s(as_modelled) for name, loop in loops.items()},
            growth_per_s={name: loop.growth(as_modelled) for name, loop in loops.items()},
            margins={name: margins(loop) for name, loop in loops.items()},
        )


def _check(setup: Setup, absent: tuple[int, ...]) -> None:
    """Raise ScenarioError if plans are not the shared control law, or not some agents are gone."""
    name = setup.scenario.name
    if setup.scenario.agents.controller != "mpc":
        raise ScenarioError(
            name, "agents.controller", "expected 'mpc', whose feedback is known, got a class"
        )
    if absent and not set(absent) < set(setup.agents):
        raise ScenarioError(
            name, "agents", f"expected some of {list(setup.agents)} gone, got {list(absent)}"
        )

    settings = setup.settings
    got = f"{settings.prediction}, {settings.terminal}, {settings.discretisation}"
    if got != _FEEDBACK:
        raise ScenarioError(
            name, "controller", f"expected {_FEEDBACK}, whose plans are a feedback, got {got}"
        )


def _loops(setup: Setup, absent: tuple[int, ...]) -> dict[str, Loop]:
    """Return the sampled loop of plant and present agents for each actuation."""
    gone = [uav for agent in absent for uav in setup.owned[agent - 1]]
    fail_safe = {uav: setup.fail_safe.gain(uav) for uav in gone}
    team = _team(setup, absent, gone)
    delay_periods = setup.scenario.links.delay_s / setup.settings.sampling_period_s
    age = max(1, math.ceil(delay_periods - _ROUNDING))
    return {
        actuation: Loop(team, next_tick=actuation == "next_tick", age=age, uncontrolled=fail_safe)
        for actuation in ACTUATIONS
    }


def _team(setup: Setup, absent: tuple[int, ...], gone: list[int]) -> list[Controller]:
    """Return the controllers of the present agents, which know the UAVs that are gone."""
    # About hover both linearisations are the same.
    settings = setup.settings.model_copy(update={"linearisation": "present"})
    reference = Sampled(X=setup.X_ref)
    team = [
        Controller(setup.model, setup.hover, settings, setup.owned[agent - 1], reference)
        for agent in setup.agents
        if agent not in absent
    ]
    if gone:
        for controller in team:
            controller.without(gone)
    return team


def rows(result: HoverMargins) -> Iterator[tuple[str, ...]]:
    """Yield property and range for each actuation, as text.

    The first row has the times in which deviations decay.
    """
    settling_s = [result.settling_s[actuation] for actuation in ACTUATIONS]
    yield (
        "deviations decay in",
        *("never" if time_s is None else f"{time_s:.2g} s" for time_s in settling_s),
    )
    for name, label in LABELS.items():
        of_actuations = [result.margins[actuation].get(name) for actuation in ACTUATIONS]
        yield label, *(_range(name, margin) for margin in of_actuations)


def _ends(name: str, margin: Margin) -> tuple[float, float]:
    """Return the ends of a range that is drawn and printed, in ms or as factors."""
    if name.endswith("_s"):
        return _MS_PER_S * (margin.lower or 0.0), _MS_PER_S * (margin.upper or FARTHEST_S)
    return margin.lower or 1.0 / FARTHEST, margin.upper or FARTHEST


def _range(name: str, margin: Margin | None) -> str:
    """Return a range in words; its ends may be beyond the searched range."""
    if margin is None:
        return "unstable"
    lower, upper = _ends(name, margin)
    above = f"> {upper:g}" if margin.upper is None else f"{upper:.3g}"
    if lower == 0.0:
        return f"up to {above}"
    below = f"< {lower:g}" if margin.lower is None else f"{lower:.3g}"
    return f"{below} to {above}"


def draw(result: HoverMargins, figure: Figure) -> None:
    """Draw the ranges as bars: times on the left, factors on the right."""
    figure.set_size_inches(COLUMN_IN, _HEIGHT_IN)
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.6))
    _draw_ranges(left, result, [name for name in LABELS if name.endswith("_s")])
    _draw_ranges(right, result, [name for name in LABELS if not name.endswith("_s")])

    left.set_xlabel("ms")
    right.set_xscale("log")
    right.axvline(1.0, color="#000000", linewidth=0.6)
    right.set_xlabel("actual value / known value")
    figure.legend(*left.get_legend_handles_labels(), loc="upper center", ncols=2)
    figure.subplots_adjust(left=0.21, right=0.98, top=0.86, bottom=0.24, wspace=0.75)


def _draw_ranges(axes: Axes, result: HoverMargins, names: list[str]) -> None:
    """Draw the ranges of some properties, a bar for each actuation."""
    for i, actuation in enumerate(ACTUATIONS):
        ranges = result.margins[actuation]  # all or none
        ends = [_ends(name, ranges[name]) for name in names if name in ranges]
        lower, upper = np.array(ends).reshape(-1, 2).T
        places = np.arange(len(lower)) + _APART * (i - 0.5)
        colour, _, _ = CURVES[i]
        axes.barh(places, upper - lower, _BAR, lower, color=colour, label=actuation)

    short_labels = [LABELS[name].split(",")[0] for name in names]
    axes.set_yticks(np.arange(len(names)), short_labels)
    axes.invert_yaxis()
