"""Conclusions of an experiment: one sentence per scenario or ownership, made from its numbers."""

from collections.abc import Iterator, Sequence

import numpy as np

from transport.experiments.statistics import PointStatistics

# Team sizes that power laws are fitted to: below four the constant part of a step dominates, and larger teams are not
# always run.
FEWEST, MOST = 4, 12
# Numbers whose growth with the team is told: name, factor, unit.
_GROWING = {
    "CPU of an agent's step": ("cpu_step_p50_ms", 1.0, "ms"),
    "CPU of the team per tick": ("cpu_team_tick_ms", 1.0, "ms"),
    "volume of plans": ("plan_bytes_per_s", 1e-3, "kB/s"),
}


def conclusions(measured: Sequence[PointStatistics], *, growth: bool = False) -> list[str]:
    """Return one sentence for each scenario or, with `growth`, for each ownership of teams of increasing size."""
    groups: dict[str, list[PointStatistics]] = {}
    for m in measured:
        groups.setdefault(str(m.point.labels["ownership"]) if growth else m.point.scenario, []).append(m)
    told = _growth if growth else _extremes
    return [f"{name}: {'; '.join([*_outcomes(own), *told(own)])}" for name, own in groups.items()]


def _outcomes(measured: Sequence[PointStatistics]) -> Iterator[str]:
    """Yield how many runs were completed, where and when the first of the others diverged, and the errors."""
    runs, completed, errors = (sum(getattr(m, name) for m in measured) for name in ("runs", "completed", "errors"))
    diverged = [(m.diverged_s[0], m.point.text) for m in measured if m.diverged_s]
    if runs:
        first = "first diverged at {:.1f} s ({})".format(*min(diverged)) if diverged else "none diverged"
        yield f"completes {completed} of {runs} runs, {first}"
    if errors:
        yield f"{errors} run{'s' * (errors > 1)} could not be simulated"


def _extremes(measured: Sequence[PointStatistics]) -> Iterator[str]:
    """Yield the largest attitude, and the lowest and highest cost over the baseline's."""
    attitudes = [(value, m.point.text) for m in measured if (value := m.mean("attitude_max_deg")) is not None]
    if attitudes:
        yield "largest payload attitude {:.2f} deg ({})".format(*max(attitudes))
    costs = [(m.cost_ratio, m.point.text) for m in measured if m.cost_ratio is not None and not m.point.baseline]
    if costs:
        ends = dict.fromkeys([min(costs), max(costs)])
        yield "cost " + " to ".join(f"x{ratio:.2f} ({text})" for ratio, text in ends)


def _growth(measured: Sequence[PointStatistics]) -> Iterator[str]:
    """Yield how numbers grow from `FEWEST` to `MOST` UAVs: p of N^p by least squares; nothing for a single team."""
    for name, (number, factor, unit) in _GROWING.items():
        means = {float(m.point.labels["uavs"]): factor * (m.mean(number) or 0.0) for m in measured}
        fitted = {uavs: value for uavs, value in sorted(means.items()) if FEWEST <= uavs <= MOST and value > 0.0}
        if len(fitted) > 1:
            sizes, values = list(fitted), list(fitted.values())
            power = np.polyfit(np.log(sizes), np.log(values), 1)[0]
            ends = f"{values[0]:.3g} to {values[-1]:.3g} {unit}"
            yield f"{name} grows as N^{power:.2f} from {sizes[0]:g} to {sizes[-1]:g} UAVs ({ends})"
