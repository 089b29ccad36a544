"""Conclusions of an experiment: one sentence per scenario or ownership, made from its numbers."""

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
        sentences.append(_sentence(name, _survival(own), _attitude(own), _cost(own), _errors(own)))
    return sentences


def _sentence(name: str, *parts: str) -> str:
    return f"{name}: {'; '.join(filter(None, parts))}"


def _survival(measured: Sequence[PointStatistics]) -> str:
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


def _errors(measured: Sequence[PointStatistics]) -> str:
    errors = sum(m.errors for m in measured)
    return f"{errors} run{'s' * (errors > 1)} could not be simulated" if errors else ""


def _divergence(m: PointStatistics) -> str:
    return f"diverged at {m.diverged_s[0]:.1f} s" if m.runs == 1 else f"{m.completed} of {m.runs}"


def _attitude(measured: Sequence[PointStatistics]) -> str:
    found = [(value, i) for i, m in enumerate(measured) if (value := m.mean("attitude_max_deg")) is not None]
    if not found:
        return ""
    worst, i = max(found, key=lambda entry: entry[0])
    mean = "on average " if measured[i].completed > 1 else ""
    return f"largest payload attitude {mean}{worst:.2f} deg ({measured[i].point.text})"


def _cost(measured: Sequence[PointStatistics]) -> str:
    """Return the cost over the baseline's, at the points where any run was completed."""
    found = [(m.cost_ratio, m.point.text) for m in measured if m.cost_ratio is not None and not m.point.baseline]
    if not found:
        return ""
    named = found if len(found) <= _NAMED else [min(found), max(found)]
    return "cost " + ", ".join(f"x{ratio:.2f} ({text})" for ratio, text in named)


def scaling_conclusions(measured: Sequence[PointStatistics]) -> list[str]:
    """Return one sentence for each ownership, and one for each comparison with the centralized team."""
    teams: dict[str, list[PointStatistics]] = {}
    for m in measured:
        teams.setdefault(str(m.point.labels["ownership"]), []).append(m)
    lines = [
        _sentence(
            ownership,
            _survival(own),
            _growth("CPU of an agent's step", _means(own, "cpu_step_p50_ms"), "ms"),
            _growth("CPU of the team per tick", _means(own, "cpu_team_tick_ms"), "ms"),
            _growth("volume of plans", _means(own, "plan_bytes_per_s", 1e-3), "kB/s"),
            _errors(own),
        )
        for ownership, own in teams.items()
    ]
    others = [ownership for ownership in teams if ownership != CENTRALIZED]
    return [*lines, *(_comparison(teams[ownership], teams[CENTRALIZED], ownership) for ownership in others)]


def _means(measured: Sequence[PointStatistics], name: str, factor: float = 1.0) -> dict[float, float]:
    """Return the mean of a number by team size, where any run was completed."""
    return {float(m.point.labels["uavs"]): factor * value for m in measured if (value := m.mean(name)) is not None}


def _growth(name: str, values: dict[float, float], unit: str) -> str:
    """Return how a number grows from `FEWEST` to `MOST` UAVs: p of N^p by least squares; nothing for a single team."""
    fitted = {uavs: value for uavs, value in values.items() if FEWEST <= uavs <= MOST and value > 0.0}
    if len(fitted) < 2:
        return ""
    power = np.polyfit(np.log(list(fitted)), np.log(list(fitted.values())), 1)[0]
    first, last = min(fitted), max(fitted)
    ends = " to ".join(f"{float(f'{fitted[uavs]:.3g}'):g}" for uavs in (first, last)) + f" {unit}"
    return f"{name} grows as N^{power:.2f} from {first:g} to {last:g} UAVs ({ends})"


def _comparison(measured: Sequence[PointStatistics], whole: Sequence[PointStatistics], ownership: str) -> str:
    """Return computation and cost over the centralized team's, for the largest team that both completed."""
    own, central = (_means(of, "cpu_step_p50_ms") for of in (measured, whole))
    both = own.keys() & central.keys()
    if not both:
        return f"{ownership} against {CENTRALIZED}: no team of both completed its run"
    uavs = max(both)
    (m,) = (m for m in measured if m.point.labels["uavs"] == uavs)
    cost = "" if m.cost_ratio is None else f", cost x{m.cost_ratio:.2f}"
    ratio = own[uavs] / central[uavs]
    return f"{ownership} against {CENTRALIZED}, {uavs:g} UAVs: CPU of an agent's step x{ratio:.3g}{cost}"
