"""Margins of a scenario's hover.

How far the plant may differ from the controllers' model; table and figure.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import threadpoolctl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from transport.mpc.margins.actual_plant import Mismatch
from transport.mpc.margins.sampled_loop import FARTHEST, FARTHEST_S, Margin, SampledLoop, margins
from transport.protocol.scenario.setup.run_setup import Setup
from transport.report.figures.style import COLUMN_IN, CURVES
from transport.report.laws import ACTUATIONS, alone_loops, check_feedback, team_loops

# Label and unit of each property of the plant; factors are relative to the value that the
# controllers know.
LABELS = {
    "lag_s": "motor lag, ms",
    "delay_s": "actuator delay, ms",
    "spread_s": "delay spread, ms",
    "gain": "actuator gain",
    "uav_inertia": "UAV inertia",
    "uav_mass": "UAV mass",
    "payload_mass": "payload mass",
    "payload_inertia": "payload inertia",
    "rod_length": "rod length",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class HoverMargins:
    """Result of the analysis, by value of `clock.actuation`.

    The plant is as the controllers know it, but for the property that a margin varies.
    """

    scenario: str
    without: tuple[int, ...]  # agents that are gone, 1-based, whose UAVs follow the fail-safe
    # Time in which the slowest deviation decays by e; None: the payload is not held.
    settling_s: dict[str, float | None]
    growth_per_s: dict[str, float]  # of the fastest growing mode
    # By property of `mpc.margins.actual_plant.Mismatch`; empty where the hover is unstable.
    margins: dict[str, dict[str, Margin]]


def hover_margins(setup: Setup, without: Collection[int] = ()) -> HoverMargins:
    """Return the margins of a scenario about hover, with some agents, 1-based, gone.

    The links have their fixed delay: agents know each other's state one sampling period late, or as
    late as `links.delay_s`. Limits, constraints, packet loss and the disturbance estimate are not
    part of the analysis. Source: docs/equations.md (60).

    Raises: ScenarioError: plans are not the shared control law, or the agents that are gone not
        some of several.
    """
    absent = tuple(sorted(set(without)))
    # Several threads are slower than one with matrices of this size.
    with threadpoolctl.threadpool_limits(1):
        if set(setup.scenario.controllers) == {"alone"} and not absent:
            return _of(setup.scenario.name, (), alone_loops(setup))
        check_feedback(setup, absent)
        return _of(setup.scenario.name, absent, team_loops(setup, absent))


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


def rows(result: HoverMargins) -> Iterator[tuple[str, ...]]:
    """Yield the rows of the table as text: a label, then a cell for each actuation.

    The first row has the time in which deviations decay, the others the ranges of the properties.
    """
    times_s = [result.settling_s[actuation] for actuation in ACTUATIONS]
    texts = ["never" if time_s is None else f"{time_s:.2g} s" for time_s in times_s]
    yield ("deviations decay in", *texts)

    for name, label in LABELS.items():
        ranges = [range_text(name, result.margins[actuation].get(name)) for actuation in ACTUATIONS]
        yield (label, *ranges)


def _ends(name: str, margin: Margin) -> tuple[float, float]:
    """Return the ends of a range that is drawn and printed, in ms or as factors."""
    if name.endswith("_s"):
        unit = 1e3
        least = 0.0
        most = FARTHEST_S
    else:
        unit = 1.0
        least = 1.0 / FARTHEST
        most = FARTHEST
    lower = least if margin.lower is None else margin.lower
    upper = most if margin.upper is None else margin.upper
    return unit * lower, unit * upper


def range_text(name: str, margin: Margin | None) -> str:
    """Return a range as text; an end that was not found is beyond the farthest value tried."""
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
    figure.set_size_inches(COLUMN_IN, 1.5)
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.6))
    _draw_bars(left, result, [name for name in LABELS if name.endswith("_s")])
    _draw_bars(right, result, [name for name in LABELS if not name.endswith("_s")])
    left.set_xlabel("ms")
    right.set_xscale("log")
    right.axvline(1.0, color="#000000", linewidth=0.6)
    right.set_xlabel("actual value / known value")
    figure.legend(*left.get_legend_handles_labels(), loc="upper center", ncols=2)
    figure.subplots_adjust(left=0.21, right=0.98, top=0.86, bottom=0.24, wspace=0.75)


def _draw_bars(axes: Axes, result: HoverMargins, names: Sequence[str]) -> None:
    """Draw the ranges of some properties, for each actuation."""
    for index, actuation in enumerate(ACTUATIONS):
        margins_by_name = result.margins[actuation]  # of all properties or of none
        ends = [_ends(name, margins_by_name[name]) for name in names if name in margins_by_name]
        lower, upper = np.array(ends).reshape(-1, 2).T
        places = np.arange(len(ends)) + 0.36 * (index - 0.5)
        axes.barh(places, upper - lower, 0.32, lower, color=CURVES[index].colour, label=actuation)
    axes.set_yticks(np.arange(len(names)), [LABELS[name].split(",")[0] for name in names])
    axes.invert_yaxis()
