"""Conclusions of an experiment: one sentence per scenario, made from its numbers."""

from collections.abc import Sequence

from transport.experiments.statistics import PointStatistics

# Points named one by one in a sentence; of more, only the extremes are named.
_NAMED = 4


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
