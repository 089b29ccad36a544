"""Conclusions of an experiment: one sentence per scenario or ownership, made from its numbers."""

import math
from collections.abc import Sequence

import numpy as np

from transport.experiments.design_experiments import CENTRALIZED
from transport.experiments.statistics import PointStatistics

# Points named one by one in a sentence; of more, only the extremes are named.
_NAMED = 4

# Team sizes that power laws are fitted to: below four the constant part of a step dominates, and larger teams are not
# always run.
FEWEST, MOST = 4, 12


def conclusions(measured: Sequence[PointStatistics]) -> list[str]:
    """Return one sentence for each scenario, in the order of the sweep."""
    sentences = []
    for name in dict.fromkeys(m.point.scenario for m in measured):
        own = [m for m in measured if m.point.scenario == name]
        parts = (survival(own), _attitude(own), _cost(own), errors_text(own))
        sentences.append(f"{name}: {'; '.join(part for part in parts if part)}")
    return sentences


def survival(measured: Sequence[PointStatistics]) -> str:
    """Return how many runs were completed, and at which points others diverged."""
    simulated = [m for m in measured if m.runs]
    if not simulated:
        return ""
    diverged = [m for m in simulated if m.completed < m.runs]
    count = f"{sum(m.completed for m in simulated)} of {sum(m.runs for m in simulated)} runs"
    if not diverged:
        return f"completes all {len(simulated)} points ({count})"
    if len(diverged) <= _NAMED:
        which = ", ".join(f"{m.point.text} ({_divergence(m)})" for m in diverged)
        return f"completes {count}, all but at {which}"
    first = min(diverged, key=lambda m: m.diverged_s)
    without = f"{len(simulated) - len(diverged)} of {len(simulated)} points without a diverged run"
    return f"completes {count}, {without}; first diverged at {first.diverged_s[0]:.1f} s ({first.point.text})"


def errors_text(measured: Sequence[PointStatistics]) -> str:
    """Return how many runs could not be simulated; nothing if all could."""
    errors = sum(m.errors for m in measured)
    return f"{errors} run{'s' * (errors > 1)} could not be simulated" if errors else ""


def _divergence(m: PointStatistics) -> str:
    return f"diverged at {m.diverged_s[0]:.1f} s" if m.runs == 1 else f"{m.completed} of {m.runs}"


def _attitude(measured: Sequence[PointStatistics]) -> str:
    found = [(value.mean, m) for m in measured if (value := m.numbers["attitude_max_deg"]) is not None]
    if not found:
        return ""
    worst, m = max(found, key=lambda entry: entry[0])
    mean = "on average " if m.completed > 1 else ""
    return f"largest payload attitude {mean}{worst:.2f} deg ({m.point.text})"


def _cost(measured: Sequence[PointStatistics]) -> str:
    """Return the cost over the baseline's, at the points where any run was completed."""
    found = [(m.cost_ratio, m.point.text) for m in measured if m.cost_ratio is not None and not m.point.baseline]
    if not found:
        return ""
    named = found if len(found) <= _NAMED else [min(found), max(found)]
    return "cost " + ", ".join(f"x{ratio:.2f} ({text})" for ratio, text in named)


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
