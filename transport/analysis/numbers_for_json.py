"""Quantiles and largest values as JSON data, None where there is nothing to measure."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from transport.model.arrays import Array


def percentiles(values: Iterable[float] | Array) -> dict[str, float | None]:
    """Return median, 99th percentile and maximum of values; None without any."""
    numbers = np.fromiter(values, dtype=np.float64)
    if not len(numbers):
        return {"p50": None, "p99": None, "max": None}

    p50, p99 = np.percentile(numbers, [50.0, 99.0])
    return {"p50": float(p50), "p99": float(p99), "max": float(numbers.max())}


def largest(values: Array) -> float | None:
    """Return the largest of some values; None without any, and for one that is not finite."""
    return finite(values.max()) if len(values) else None


def finite(value: Any) -> float | None:
    """Return a finite number; None for one that overflowed in a diverged run.

    JSON has neither infinity nor NaN.
    """
    return float(value) if np.isfinite(value) else None
