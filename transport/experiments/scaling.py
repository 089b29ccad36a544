"""Scaling with the number of UAVs: the sweep, and how computation, messages and cost grow."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from transport.experiments.cases import Point, Team
from transport.experiments.conclusions import errors_text, survival
from transport.experiments.errors import refused
from transport.experiments.experiment import Experiment
from transport.experiments.quantities import axis
from transport.experiments.statistics import PointStatistics

# UAVs per agent, by ownership; None: one agent for all.
OWNERSHIPS: Mapping[str, int | None] = {"distributed": 1, "pairs": 2, "centralized": None}
CENTRALIZED = "centralized"

# Team sizes below the largest. Beyond 16 UAVs a tick of the centralized team takes most of a second.
SIZES, QUICK_SIZES = (2, 3, 4, 6, 8, 10, 12, 16), (2, 4, 6)
LARGEST_TEAM = 16

# Team sizes that power laws are fitted to: below four the constant part of a step dominates, and larger teams are not
# always run.
FEWEST, MOST = 4, 12


def scaling(scenario: str, largest: int, sizes: Sequence[int]) -> Experiment:
    """Return teams of increasing size up to the largest: each with an agent for every UAV, every pair, and all."""
    if not 2 <= largest <= LARGEST_TEAM:
        raise refused("--max", f"a number of UAVs from 2 to {LARGEST_TEAM}", largest)
    points = []
    for ownership, group in OWNERSHIPS.items():
        for uavs in [*(size for size in sizes if size < largest), largest]:
            if group == 2 and (uavs == 2 or uavs % 2):
                continue  # a single pair is the centralized team; an odd number has no pairs
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
    return Experiment(
        name="scaling", points=tuple(points), x=axis("uavs"), drawn_as="scaling", curves="ownership", timed=True
    )


def exponent(uavs: Sequence[float], values: Sequence[float]) -> float | None:
    """Return p of the power law value ~ N^p, fitted by least squares to log value over log N.

    Args:
        uavs: N.
        values: Value at each N, > 0.
    Returns: p, or None for fewer than two team sizes.
    """
    if len(set(uavs)) < 2:
        return None
    logs = np.log(np.array([uavs, values], dtype=np.float64))
    x, y = logs - logs.mean(axis=1, keepdims=True)
    return float(x @ y / (x @ x))


def scaling_conclusions(measured: Sequence[PointStatistics]) -> list[str]:
    """Return one sentence for each ownership, and one for each comparison with the centralized team."""
    ownerships = dict.fromkeys(str(m.point.labels["ownership"]) for m in measured)
    lines = []
    for ownership in ownerships:
        parts = [
            survival([m for m in measured if m.point.labels["ownership"] == ownership]),
            _growth("CPU of an agent's step", _means(measured, ownership, "cpu_step_p50_ms"), "ms", 1.0),
            _growth("CPU of the team per tick", _means(measured, ownership, "cpu_team_tick_ms"), "ms", 1.0),
            _growth("volume of plans", _means(measured, ownership, "plan_bytes_per_s"), "kB/s", 1e-3),
            errors_text([m for m in measured if m.point.labels["ownership"] == ownership]),
        ]
        lines.append(f"{ownership}: {'; '.join(part for part in parts if part)}")
    return [*lines, *(_comparison(measured, other) for other in ownerships if other != CENTRALIZED)]


def _means(measured: Sequence[PointStatistics], ownership: str, name: str) -> dict[int, float]:
    """Return the mean of a number by team size for one ownership, where any run was completed."""
    return {
        int(m.point.labels["uavs"]): value.mean
        for m in measured
        if m.point.labels["ownership"] == ownership and (value := m.numbers[name]) is not None
    }


def _growth(name: str, values: dict[int, float], unit: str, factor: float) -> str:
    """Return how a number grows from `FEWEST` to `MOST` UAVs; nothing for fewer than two teams."""
    fitted = {uavs: value for uavs, value in values.items() if FEWEST <= uavs <= MOST and value > 0.0}
    power = exponent(list(fitted), list(fitted.values()))
    if power is None:
        return ""
    first, last = min(fitted), max(fitted)
    ends = " to ".join(f"{float(f'{factor * fitted[uavs]:.3g}'):g}" for uavs in (first, last)) + f" {unit}"
    return f"{name} grows as N^{power:.2f} from {first} to {last} UAVs ({ends})"


def _comparison(measured: Sequence[PointStatistics], ownership: str) -> str:
    """Return computation and cost over the centralized team's, for the largest team that both completed."""
    own, central = (_means(measured, name, "cpu_step_p50_ms") for name in (ownership, CENTRALIZED))
    both = own.keys() & central.keys()
    if not both:
        return f"{ownership} against {CENTRALIZED}: no team of both completed its run"
    uavs = max(both)
    cost, reference = (_means(measured, name, "cost_mean")[uavs] for name in (ownership, CENTRALIZED))
    ratio = cost / reference if reference > 0.0 else math.nan
    return (
        f"{ownership} against {CENTRALIZED}, {uavs} UAVs: "
        f"CPU of an agent's step x{own[uavs] / central[uavs]:.3g}, cost x{ratio:.2f}"
    )
