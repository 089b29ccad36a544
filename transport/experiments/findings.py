"""What an experiment found, in one sentence per scenario made from its numbers."""

from collections.abc import Sequence

from transport.experiments.statistics import Measured

# Points named one by one in a sentence; of more, the outermost.
_NAMED = 4


def findings(measured: Sequence[Measured]) -> list[str]:
    """One sentence for each scenario, in the order of the sweep."""
    scenarios = dict.fromkeys(m.point.scenario for m in measured)
    return [f"{name}: {_sentence([m for m in measured if m.point.scenario == name])}" for name in scenarios]


def _sentence(measured: Sequence[Measured]) -> str:
    parts = [survival(measured), _attitude(measured), _cost(measured)]
    errors = sum(m.errors for m in measured)
    if errors:
        parts.append(f"{errors} flight{'s' * (errors > 1)} could not be flown")
    return "; ".join(part for part in parts if part)


def survival(measured: Sequence[Measured]) -> str:
    """How many flights were completed, and where others were lost."""
    flown = [m for m in measured if m.flights]
    if not flown:
        return ""
    lost = [m for m in flown if m.completed < m.flights]
    flights, completed = sum(m.flights for m in flown), sum(m.completed for m in flown)
    count = f"{completed} of {flights} flights"
    if not lost:
        return f"completes all {len(flown)} points ({count})"
    if len(lost) <= _NAMED:
        which = ", ".join(f"{m.point.text} ({_loss(m)})" for m in lost)
        return f"completes {count}, all but at {which}"
    first = min(lost, key=lambda m: m.lost_s)
    held = f"{len(flown) - len(lost)} of {len(flown)} points without a lost flight"
    return f"completes {count}, {held}; first lost at {first.lost_s[0]:.1f} s ({first.point.text})"


def _loss(m: Measured) -> str:
    return f"lost at {m.lost_s[0]:.1f} s" if m.flights == 1 else f"{m.completed} of {m.flights}"


def _attitude(measured: Sequence[Measured]) -> str:
    found = [(value.mean, m) for m in measured if (value := m.numbers["attitude_max_deg"]) is not None]
    if not found:
        return ""
    worst, m = max(found, key=lambda entry: entry[0])
    mean = "on average " if m.completed > 1 else ""
    return f"largest payload attitude {mean}{worst:.2f} deg ({m.point.text})"


def _cost(measured: Sequence[Measured]) -> str:
    """Cost against the flight without impairment, at the points where anything was completed."""
    found = [(m.cost_ratio, m.point.text) for m in measured if m.cost_ratio is not None and not m.point.baseline]
    if not found:
        return ""
    named = found if len(found) <= _NAMED else [min(found), max(found)]
    return "cost " + ", ".join(f"x{ratio:.2f} ({text})" for ratio, text in named)
