"""Delivered share and delays of a case, and how far two of them are apart."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.radio.cases import Case, sends
from benchmarks.radio.reference import Arrivals

REFERENCE = Path(__file__).resolve().parent / "ns3.json"

# Bars of the comparison.
SHARE_APART = 0.03
DELAY_APART = 0.1  # of the delay, or
DELAY_APART_MS = 0.2
# Delays gather at multiples of a frame: a quantile that falls between two of them is random, in both.
# Its neighbours at these percentages bound it.
RANKS = {50: (48.0, 52.0), 99: (98.7, 99.3)}
# Fewer deliveries have no quantile that could be compared.
FEWEST = 200


@dataclass(frozen=True, slots=True)
class Quantile:
    """A quantile of the delay, ms, and its neighbours."""

    ms: float
    lower_ms: float
    upper_ms: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Numbers:
    """What a case delivered."""

    share: float  # of all frames at all receivers
    deliveries: int
    p50: Quantile | None  # None without deliveries
    p99: Quantile | None


def numbers(case: Case, arrivals: Arrivals) -> Numbers:
    """Return the numbers of a case from its arrivals."""
    sent = sends(case)
    receivers = 1 if case.unicast else len(case.positions) - 1
    delays_ms = [(time_ns - sent[send].time_ns) / 1e6 for (send, _), time_ns in arrivals.items()]
    share = len(arrivals) / (len(sent) * receivers)
    p50, p99 = (_quantile(delays_ms, percent) for percent in RANKS)
    return Numbers(share=share, deliveries=len(arrivals), p50=p50, p99=p99)


def _quantile(delays_ms: list[float], percent: int) -> Quantile | None:
    if not delays_ms:
        return None
    values = np.percentile(delays_ms, (percent, *RANKS[percent]))
    return Quantile(*[round(float(value), 4) for value in values])


def differences(model: Numbers, reference: Numbers) -> list[str]:
    """Return what is further apart than the bars, in words."""
    apart = []
    if abs(model.share - reference.share) > SHARE_APART:
        apart.append(f"delivered share {model.share:.4f}, ns-3 {reference.share:.4f}")
    if min(model.deliveries, reference.deliveries) < FEWEST:
        return apart
    for name in ("p50", "p99"):
        ours, theirs = getattr(model, name), getattr(reference, name)
        if _gap_ms(ours, theirs) > max(DELAY_APART * theirs.ms, DELAY_APART_MS):
            apart.append(f"{name} {ours.ms:.2f} ms, ns-3 {theirs.ms:.2f} ms")
    return apart


def _gap_ms(model: Quantile, reference: Quantile) -> float:
    """Return how far the neighbourhoods of two quantiles are apart, ms."""
    return max(reference.lower_ms - model.upper_ms, model.lower_ms - reference.upper_ms, 0.0)


def read() -> dict[str, Numbers]:
    """Return the committed numbers of ns-3, by the name of the case."""
    given = json.loads(REFERENCE.read_text(encoding="utf-8"))
    return {name: _numbers(values) for name, values in given["cases"].items()}


def _numbers(values: dict[str, Any]) -> Numbers:
    p50, p99 = (Quantile(**values[name]) if values[name] else None for name in ("p50", "p99"))
    return Numbers(share=values["share"], deliveries=values["deliveries"], p50=p50, p99=p99)


def write(version: str, results: dict[str, Numbers]) -> None:
    """Write the numbers of ns-3, for the tests."""
    content = {
        "source": f"ns-3 {version}, benchmarks/radio/reference.cc",
        "cases": {name: asdict(values) for name, values in results.items()},
    }
    REFERENCE.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
