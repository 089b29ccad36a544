"""Margins of a scenario's hover: how far the plant may differ from the controllers' model; table and figure."""

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass

import numpy as np
import threadpoolctl
from matplotlib.figure import Figure

from mpc.controller import Controller
from mpc.margins import FARTHEST, FARTHEST_S, GROWTH, Loop, Margin, Mismatch, margins
from protocol.scenario.errors import ScenarioError
from protocol.scenario.setup import Setup
from transport.report.style import COLUMN_IN, CURVES

# Label and unit of each property of the plant; factors are relative to the value that the controllers know.
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


@dataclass(frozen=True, slots=True, kw_only=True)
class HoverMargins:
    """Result of the analysis, for both values of `clock.actuation`.

    Attributes:
        scenario: Its name.
        growth: Growth rate of the fastest growing mode with the plant as known, 1/s.
        margins: Of each property of `mpc.margins.Mismatch`, none where the hover is unstable as known.
    """

    scenario: str
    growth: dict[str, float]
    margins: dict[str, dict[str, Margin]]

    def tree(self) -> dict[str, object]:
        """Return the result as plain values; None stands for beyond the searched range."""
        plain = asdict(self)
        return {"scenario": self.scenario, "growth_per_s": self.growth, "margins": plain["margins"]}


def hover_margins(setup: Setup) -> HoverMargins:
    """Return the margins of a scenario about hover, with the fixed delay of its links.

    Agents know each other's state one sampling period late, or as late as `links.delay_s`. Limits, constraints, packet
    loss and the disturbance estimate are not part of the analysis.

    Raises: ScenarioError: the controller is a class of the user.
    Source: docs/equations.md (58).
    """
    if setup.scenario.agents.controller != "mpc":
        expected = "expected 'mpc', whose feedback is known, for margins"
        raise ScenarioError(setup.scenario.name, "agents.controller", f"{expected}, got a class")
    period_s = setup.settings.sampling_period_s
    age = max(1, math.ceil(setup.scenario.links.delay_s / period_s - 1e-9))
    # Several threads are slower than one with matrices of this size.
    with threadpoolctl.threadpool_limits(1):
        settings = setup.settings.model_copy(update={"linearisation": "present"})  # about hover both are the same
        team = [Controller(setup.model, setup.hover, settings, owned) for owned in setup.owned]
        loops = {name: Loop(team, next_tick=name == "next_tick", age=age) for name in ACTUATIONS}
        growth = {name: loop.growth(Mismatch(lag_s=loop.known_lag_s)) for name, loop in loops.items()}
        return HoverMargins(
            scenario=setup.scenario.name,
            growth=growth,
            margins={name: margins(loop) for name, loop in loops.items()},
        )


def rows(found: HoverMargins) -> Iterator[tuple[str, ...]]:
    """Yield property and range for each actuation, as text."""
    for name, label in LABELS.items():
        yield (label, *(_range(name, found.margins[actuation].get(name)) for actuation in ACTUATIONS))


def _range(name: str, margin: Margin | None) -> str:
    if margin is None:
        return "unstable"
    unit, farthest = (1e3, FARTHEST_S) if name.endswith("_s") else (1.0, FARTHEST)
    lower = 0.0 if margin.lower is None else margin.lower
    upper = f"> {farthest * unit:g}" if margin.upper is None else f"{margin.upper * unit:.3g}"
    if name.endswith("_s") and lower == 0.0:
        return f"up to {upper}"
    below = f"< {1.0 / farthest:g}" if margin.lower is None else f"{lower * unit:.3g}"
    return f"{below} to {upper}"


def notes(found: HoverMargins) -> Iterator[str]:
    """Yield what is unstable with the plant as the controllers know it."""
    for actuation, growth in found.growth.items():
        if growth > GROWTH:
            yield f"{actuation}: the hover is unstable, deviations grow by e in {1.0 / growth:.3g} s"


def draw(found: HoverMargins, figure: Figure) -> None:
    """Draw the ranges as bars: times on the left, factors on the right."""
    figure.set_size_inches(COLUMN_IN, 1.5)
    times = [name for name in LABELS if name.endswith("_s")]
    factors = [name for name in LABELS if name not in times]
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.6))
    for axes, names, unit in ((left, times, 1e3), (right, factors, 1.0)):
        for i, actuation in enumerate(ACTUATIONS):
            for j, name in enumerate(names):
                margin = found.margins[actuation].get(name)
                if margin is None:
                    continue
                farthest = FARTHEST_S if unit > 1.0 else FARTHEST
                lower = margin.lower or (0.0 if unit > 1.0 else 1.0 / farthest)
                upper = margin.upper or farthest
                axes.barh(
                    j + 0.36 * (i - 0.5), unit * (upper - lower), 0.32, unit * lower, color=CURVES[i][0],
                    label=actuation if j == 0 else None,
                )  # fmt: skip
        axes.set_yticks(np.arange(len(names)), [LABELS[name].split(",")[0] for name in names])
        axes.invert_yaxis()
    left.set_xlabel("ms")
    right.set_xscale("log")
    right.axvline(1.0, color="#000000", linewidth=0.6)
    right.set_xlabel("actual value / known value")
    figure.legend(*left.get_legend_handles_labels(), loc="upper center", ncols=2)
    figure.subplots_adjust(left=0.21, right=0.98, top=0.86, bottom=0.24, wspace=0.75)
