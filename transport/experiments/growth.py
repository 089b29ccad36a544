"""How cost, computation and messages grow with the team, in one sentence for each ownership."""

import math
from collections.abc import Sequence

import numpy as np

from transport.experiments.catalogue import CENTRALIZED
from transport.experiments.findings import survival
from transport.experiments.statistics import Measured

# Teams that a growth is fitted to: below four the fixed work of a step hides it, and larger ones are not always flown.
FEWEST, MOST = 4, 12


def exponent(uavs: Sequence[float], values: Sequence[float]) -> float | None:
    """p of the power law value ~ N^p that fits best: the slope of log value over log N, by least squares.

    Args:
        uavs: N.
        values: At each, > 0.
    Returns: p, or None for less than two sizes of teams.
    """
    if len(set(uavs)) < 2:
        return None
    logs = np.log(np.array([uavs, values], dtype=np.float64))
    at, above = logs - logs.mean(axis=1, keepdims=True)
    return float(at @ above / (at @ at))


def curve(measured: Sequence[Measured], ownership: str, name: str) -> dict[int, float]:
    """A number over N for one ownership, where any flight was completed."""
    return {
        int(m.point.labels["uavs"]): value.mean
        for m in measured
        if m.point.labels["ownership"] == ownership and (value := m.numbers[name]) is not None
    }


def growth_findings(measured: Sequence[Measured]) -> list[str]:
    """One sentence for each ownership, and one that compares."""
    ownerships = dict.fromkeys(str(m.point.labels["ownership"]) for m in measured)
    lines = []
    for ownership in ownerships:
        own = [m for m in measured if m.point.labels["ownership"] == ownership]
        parts = [
            survival(own),
            _grown("CPU of an agent's step", curve(own, ownership, "cpu_step_p50_ms"), "ms", 1.0),
            _grown("CPU of the team per tick", curve(own, ownership, "cpu_team_tick_ms"), "ms", 1.0),
            _grown("volume of plans", curve(own, ownership, "plan_bytes_per_s"), "kB/s", 1e-3),
        ]
        errors = sum(m.errors for m in own)
        if errors:
            parts.append(f"{errors} flight{'s' * (errors > 1)} could not be flown")
        lines.append(f"{ownership}: {'; '.join(part for part in parts if part)}")
    return [*lines, *(_compared(measured, other) for other in ownerships if other != CENTRALIZED)]


def _grown(what: str, values: dict[int, float], unit: str, factor: float) -> str:
    """How something grows from `FEWEST` to `MOST` UAVs; nothing where there is none of it or no second team."""
    fitted = {uavs: value for uavs, value in values.items() if FEWEST <= uavs <= MOST and value > 0.0}
    power = exponent(list(fitted), list(fitted.values()))
    if power is None:
        return ""
    first, last = min(fitted), max(fitted)
    ends = " to ".join(f"{float(f'{factor * fitted[uavs]:.3g}'):g}" for uavs in (first, last)) + f" {unit}"
    return f"{what} grows as N^{power:.2f} from {first} to {last} UAVs ({ends})"


def _compared(measured: Sequence[Measured], ownership: str) -> str:
    """What an ownership takes and costs against one agent for all, in the largest team that both completed."""
    own, central = (curve(measured, who, "cpu_step_p50_ms") for who in (ownership, CENTRALIZED))
    both = own.keys() & central.keys()
    if not both:
        return f"{ownership} against {CENTRALIZED}: no team of both completed its flight"
    uavs = max(both)
    cost, least = (curve(measured, who, "cost_mean")[uavs] for who in (ownership, CENTRALIZED))
    ratio = cost / least if least > 0.0 else math.nan
    return (
        f"{ownership} against {CENTRALIZED}, {uavs} UAVs: "
        f"CPU of an agent's step x{own[uavs] / central[uavs]:.3g}, cost x{ratio:.2f}"
    )
