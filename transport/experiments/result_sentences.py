"""Conclusions of an experiment in sentences: what completes, extremes, and growth with the team."""

from collections.abc import Iterator, Sequence

import numpy as np

from transport.experiments.statistics import PointStatistics

# Team sizes that power laws are fitted to: below four the constant part of a step dominates, and
# larger teams are not always run.
FEWEST = 4
MOST = 12
# Numbers whose growth with the team is told: name, factor, unit.
_GROWING = {
    "CPU of an agent's step": ("cpu_step_p50_ms", 1.0, "ms"),
    "CPU of the team per tick": ("cpu_team_tick_ms", 1.0, "ms"),
    "volume of plans": ("plan_bytes_per_s", 1e-3, "kB/s"),
}


def conclusions(measured: Sequence[PointStatistics]) -> list[str]:
    """Return one sentence for each scenario.

    With teams of increasing size it is one for each ownership.
    """
    groups: dict[str, list[PointStatistics]] = {}
    for one in measured:
        group = str(one.point.labels.get("ownership", one.point.scenario))
        groups.setdefault(group, []).append(one)

    clauses_of = _growth if "ownership" in measured[0].point.labels else _extremes
    sentences = []
    for name, own in groups.items():
        clauses = [*_outcomes(own), *clauses_of(own)]
        sentences.append(f"{name}: {'; '.join(clauses)}")
    return sentences


def _outcomes(measured: Sequence[PointStatistics]) -> Iterator[str]:
    """Yield how many runs were completed and where the first of the others diverged.

    Errors are told, too.
    """
    runs = sum(one.runs for one in measured)
    completed = sum(one.completed for one in measured)
    errors = sum(one.errors for one in measured)

    if runs:
        diverged = [(one.diverged_s[0], one.point.text) for one in measured if one.diverged_s]
        first = "none diverged"
        if diverged:
            first = "first diverged at {:.1f} s ({})".format(*min(diverged))
        yield f"completes {completed} of {runs} runs, {first}"
    if errors:
        yield f"{errors} run{'s' * (errors > 1)} could not be simulated"


def _extremes(measured: Sequence[PointStatistics]) -> Iterator[str]:
    """Yield the largest attitude, and the lowest and highest cost over the baseline's."""
    attitudes_deg = []
    ratios = []
    for one in measured:
        attitude_deg = one.mean("attitude_max_deg")
        if attitude_deg is not None:
            attitudes_deg.append((attitude_deg, one.point.text))
        if one.cost_ratio is not None and not one.point.baseline:
            ratios.append((one.cost_ratio, one.point.text))

    if attitudes_deg:
        yield "largest payload attitude {:.2f} deg ({})".format(*max(attitudes_deg))
    if ratios:
        ends = dict.fromkeys([min(ratios), max(ratios)])
        yield "cost " + " to ".join(f"x{ratio:.2f} ({text})" for ratio, text in ends)


def _growth(measured: Sequence[PointStatistics]) -> Iterator[str]:
    """Yield how numbers grow from `FEWEST` to `MOST` UAVs: p of N^p by least squares.

    Nothing for a single team.
    """
    for name, (number, factor, unit) in _GROWING.items():
        means = {
            float(one.point.labels["uavs"]): factor * (one.mean(number) or 0.0) for one in measured
        }
        fitted = {
            uavs: value
            for uavs, value in sorted(means.items())
            if FEWEST <= uavs <= MOST and value > 0.0
        }
        if len(fitted) < 2:
            continue

        # log value = p log N + constant
        sizes = list(fitted)
        values = list(fitted.values())
        power = np.polyfit(np.log(sizes), np.log(values), 1)[0]
        teams = f"from {sizes[0]:g} to {sizes[-1]:g} UAVs"
        ends = f"{values[0]:.3g} to {values[-1]:.3g} {unit}"
        yield f"{name} grows as N^{power:.2f} {teams} ({ends})"
