"""Sentences about hand-made points: what completes, the extremes, and the power of a team's size."""

from collections.abc import Mapping

import pytest

from transport.experiments.cases import Point
from transport.experiments.result_sentences import conclusions
from transport.experiments.statistics import Estimate, PointStatistics

RUNS = 3


def point(
    text: str,
    labels: Mapping[str, str | float],
    numbers: Mapping[str, float],
    *,
    ratio: float | None = None,
    diverged_s: tuple[float, ...] = (),
    errors: int = 0,
) -> PointStatistics:
    """Return a point of `paper` whose other runs complete with these means."""
    means = {name: Estimate(mean, 0.0, RUNS, mean, mean) for name, mean in numbers.items()}
    return PointStatistics(
        point=Point(labels=labels, text=text, scenario="paper", baseline=ratio == 1.0),
        runs=RUNS,
        completed=RUNS - len(diverged_s),
        errors=errors,
        diverged_s=diverged_s,
        numbers=means,
        cost_ratio=ratio,
    )


def test_a_sentence_tells_what_completes_and_the_extremes() -> None:
    """The earliest divergence of all points, the largest attitude, and the costs but the baseline's."""
    attitude = "attitude_max_deg"
    measured = [
        point("0 ms", {"delay_s": 0.0}, {attitude: 1.0}, ratio=1.0),
        point("100 ms", {"delay_s": 0.1}, {attitude: 3.25}, ratio=1.5, diverged_s=(8.0,)),
        point("200 ms", {"delay_s": 0.2}, {attitude: 2.0}, ratio=2.25, diverged_s=(4.5,), errors=1),
    ]
    assert conclusions(measured) == [
        "paper: completes 7 of 9 runs, first diverged at 4.5 s (200 ms); "
        "1 run could not be simulated; largest payload attitude 3.25 deg (100 ms); "
        "cost x1.50 (100 ms) to x2.25 (200 ms)"
    ]


@pytest.mark.parametrize("power", [1.0, 2.5])
def test_growth_is_the_power_of_the_size(power: float) -> None:
    """Times of c N^p grow as N^p; teams below four UAVs, in which the constant part dominates, do not count."""
    sizes = {2: 100.0, 4: 4.0**power, 8: 8.0**power, 12: 12.0**power}
    without = {"cpu_team_tick_ms": 0.0, "plan_bytes_per_s": 0.0}
    measured = []
    for uavs, step_ms in sizes.items():
        labels: Mapping[str, str | float] = {"ownership": "pairs", "uavs": uavs}
        measured.append(point(f"{uavs} UAVs", labels, {"cpu_step_p50_ms": step_ms, **without}))
    (sentence,) = conclusions(measured)
    assert sentence.startswith("pairs: completes 12 of 12 runs, none diverged; ")
    assert f"CPU of an agent's step grows as N^{power:.2f} from 4 to 12 UAVs" in sentence
