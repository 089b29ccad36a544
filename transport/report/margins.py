"""Margins of a scenario's hover.

How far the plant may differ from the controllers' model; table and figure.
"""

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import threadpoolctl
from matplotlib.figure import Figure

from transport.mpc.actual_plant import Mismatch
from transport.mpc.alone_margins import AloneLoop
from transport.mpc.controller import Controller
from transport.mpc.margins import FARTHEST, FARTHEST_S, Loop, Margin, SampledLoop, margins
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


@dataclass(frozen=True, slots=True, kw_only=True)
class HoverMargins:
    """Result of the analysis, for both values of `clock.actuation`, with the plant as known but for `margins`."""

    scenario: str
    without: tuple[int, ...]  # agents that are gone, 1-based, whose UAVs follow the fail-safe
    settling_s: dict[
        str, float | None
    ]  # in which the slowest deviation decays by e; None: the payload is not held
    growth_per_s: dict[str, float]  # of the fastest growing mode
    margins: dict[
        str, dict[str, Margin]
    ]  # of the properties of `mpc.margins.Mismatch`; none where it is unstable


def hover_margins(setup: Setup, without: Collection[int] = ()) -> HoverMargins:
    """Return the margins of a scenario about hover, with the fixed delay of its links, some agents, 1-based, gone.

    Agents know each other's state one sampling period late, or as late as `links.delay_s`. Limits,
    constraints, packet
    loss and the disturbance estimate are not part of the analysis. Source: docs/equations.md (60).

    Raises: ScenarioError: plans are not the shared control law, or the agents that are gone not
        some of several.
    """
    absent, name, settings = tuple(sorted(set(without))), setup.scenario.name, setup.settings
    if setup.scenario.agents.controller == "alone" and not absent:
        return _alone(setup)
    if setup.scenario.agents.controller != "mpc":
        raise ScenarioError(
            name, "agents.controller", "expected 'mpc', whose feedback is known, got a class"
        )
    if absent and not set(absent) < set(setup.agents):
        raise ScenarioError(
            name, "agents", f"expected some of {list(setup.agents)} gone, got {list(absent)}"
        )
    got = f"{settings.prediction}, {settings.terminal}, {settings.discretisation}"
    if got != _FEEDBACK:
        raise ScenarioError(
            name, "controller", f"expected {_FEEDBACK}, whose plans are a feedback, got {got}"
        )
    gone = [uav for agent in absent for uav in setup.owned[agent - 1]]
    age = max(1, math.ceil(setup.scenario.links.delay_s / settings.sampling_period_s - 1e-9))
    # Several threads are slower than one with matrices of this size.
    with threadpoolctl.threadpool_limits(1):
        settings = settings.model_copy(
            update={"linearisation": "present"}
        )  # about hover both are the same
        present = [setup.owned[agent - 1] for agent in setup.agents if agent not in absent]
        team = [
            Controller(setup.model, setup.hover, settings, owned, Sampled(X=setup.X_ref))
            for owned in present
        ]
        for controller in team if gone else ():
            controller.without(gone)
        fail_safe = {uav: setup.fail_safe.gain(uav) for uav in gone}
        loops = {
            actuation: Loop(
                team, next_tick=actuation == "next_tick", age=age, uncontrolled=fail_safe
            )
            for actuation in ACTUATIONS
        }
        return _of(name, absent, loops)


def _alone(setup: Setup) -> HoverMargins:
    """Return the margins of UAVs that all follow the reference alone."""
    period_s = setup.settings.sampling_period_s
    with threadpoolctl.threadpool_limits(1):
        loops = {
            actuation: AloneLoop(setup.system, period_s, next_tick=actuation == "next_tick")
            for actuation in ACTUATIONS
        }
        return _of(setup.scenario.name, (), loops)


def _of(name: str, absent: tuple[int, ...], loops: Mapping[str, SampledLoop]) -> HoverMargins:
    """Return the margins of a loop for each actuation."""
    known = {actuation: Mismatch(lag_s=loop.known_lag_s) for actuation, loop in loops.items()}
    return HoverMargins(
        scenario=name,
        without=absent,
        settling_s={of: loop.settling_s(known[of]) for of, loop in loops.items()},
        growth_per_s={of: loop.growth(known[of]) for of, loop in loops.items()},
        margins={of: margins(loop) for of, loop in loops.items()},
    )


def rows(found: HoverMargins) -> Iterator[tuple[str, ...]]:
    """Yield property and range for each actuation, as text, and first in which time deviations decay."""
    settling = (found.settling_s[actuation] for actuation in ACTUATIONS)
    yield (
        "deviations decay in",
        *("never" if time_s is None else f"{time_s:.2g} s" for time_s in settling),
    )
    for name, label in LABELS.items():
        yield (
            label,
            *(_range(name, found.margins[actuation].get(name)) for actuation in ACTUATIONS),
        )


def _ends(name: str, margin: Margin) -> tuple[float, float]:
    """Return the ends of a range that is drawn and printed, in ms or as factors."""
    unit, least, most = (
        (1e3, 0.0, FARTHEST_S) if name.endswith("_s") else (1.0, 1.0 / FARTHEST, FARTHEST)
    )
    lower = least if margin.lower is None else margin.lower
    upper = most if margin.upper is None else margin.upper
    return unit * lower, unit * upper


def _range(name: str, margin: Margin | None) -> str:
    if margin is None:
        return "unstable"
    lower, upper = _ends(name, margin)
    above = f"> {upper:g}" if margin.upper is None else f"{upper:.3g}"
    if lower == 0.0:
        return f"up to {above}"
    return f"{f'< {lower:g}' if margin.lower is None else f'{lower:.3g}'} to {above}"


def draw(found: HoverMargins, figure: Figure) -> None:
    """Draw the ranges as bars: times on the left, factors on the right."""
    figure.set_size_inches(COLUMN_IN, 1.5)
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.6))
    for axes, is_time in ((left, True), (right, False)):
        names = [name for name in LABELS if name.endswith("_s") == is_time]
        for i, actuation in enumerate(ACTUATIONS):
            of = found.margins[actuation]  # all or none
            lower, upper = (
                np.array([_ends(name, of[name]) for name in names if name in of]).reshape(-1, 2).T
            )
            places = np.arange(len(lower)) + 0.36 * (i - 0.5)
            axes.barh(places, upper - lower, 0.32, lower, color=CURVES[i][0], label=actuation)
        axes.set_yticks(np.arange(len(names)), [LABELS[name].split(",")[0] for name in names])
        axes.invert_yaxis()
    left.set_xlabel("ms")
    right.set_xscale("log")
    right.axvline(1.0, color="#000000", linewidth=0.6)
    right.set_xlabel("actual value / known value")
    figure.legend(*left.get_legend_handles_labels(), loc="upper center", ncols=2)
    figure.subplots_adjust(left=0.21, right=0.98, top=0.86, bottom=0.24, wspace=0.75)
