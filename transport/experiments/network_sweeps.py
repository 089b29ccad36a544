"""Sweeps over the network: delay, packet loss, jitter, and the number of plans that are sent."""

import math
from collections.abc import Mapping, Sequence

from transport.experiments.cases import Point
from transport.experiments.errors import refused
from transport.experiments.experiment import NONE, SMALLEST, Experiment, check_numbers, distinct
from transport.experiments.quantities import Axis, axis

# Standard deviation of one unit of `links.jitter_s`, and the mean it adds, by distribution (docs/keys.md).
# A lognormal number whose logarithm has unit variance has a mean of 1 / sqrt(e - 1) standard deviations.
JITTER = {
    "uniform": (1.0 / math.sqrt(12.0), 0.0),
    "normal": (1.0, 0.0),
    "exponential": (1.0, 1.0),
    "lognormal": (1.0, 1.0 / math.sqrt(math.e - 1.0)),
}

# Smallest mean delay at which the random part is never cut off at zero, in standard deviations; the normal
# distribution has no such mean: 2 cut off 2 %.
SMALLEST_MEAN = {"uniform": math.sqrt(3.0), "normal": 2.0, "exponential": 1.0, "lognormal": JITTER["lognormal"][1]}

# A good and a bad network, with their settings.
NETWORKS: Mapping[str, tuple[str, ...]] = {
    "perfect": ("links.delay_s=0.0", "links.loss=0.0"),
    "200 ms delay, 30 % loss": ("links.delay_s=0.2", "links.loss=0.3"),
}

_DELAY_AXIS, _LOSS_AXIS = axis("delay_s", "links.delay_s"), axis("loss", "links.loss")
# Threshold of `controller.share`; at 0 all plans are sent.
_THRESHOLD_AXIS = Axis("share_threshold", "threshold (% of the input's range; 0: all plans sent)", 100.0)


def latency(scenarios: Sequence[str], delays_s: Sequence[float]) -> Experiment:
    """Return the sweep over a constant delay of every plan."""
    check_numbers("--delay", delays_s, "a delay >= 0 s", 0.0)
    points = [
        Point(
            scenario=scenario,
            labels={"delay_s": delay_s},
            text=_ms(delay_s),
            settings=(f"links.delay_s={delay_s!r}",),
            baseline=delay_s == 0.0,
        )
        for scenario in distinct("--scenario", scenarios)
        for delay_s in sorted({0.0, *delays_s})
    ]
    return Experiment(name="latency", points=tuple(points), x=_DELAY_AXIS)


def loss(scenarios: Sequence[str], shares: Sequence[float], burst_ticks: float) -> Experiment:
    """Return the sweep over independent packet loss, and burst loss with the same mean (Gilbert-Elliott).

    Shares are mean shares of lost plans. Every plan in a burst is lost; burst lengths are means, in ticks.
    """
    check_numbers("--loss", shares, "a share from 0 to below 1", 0.0, 1.0)
    check_numbers("--burst", [burst_ticks], "a mean length >= 1 tick", 1.0)
    lossy = sorted(share for share in shares if share > 0.0)
    losses = [
        (NONE, 0.0, "no loss", "links.loss=0.0"),
        *(("bernoulli", share, f"{_percent(share)} at random", f"links.loss={share!r}") for share in lossy),
        *(("bursts", share, f"{_percent(share)} in bursts", _bursts(share, burst_ticks)) for share in lossy),
    ]
    points = [
        Point(
            scenario=scenario,
            labels={"model": model, "loss": share},
            text=text,
            settings=(setting,),
            baseline=model == NONE,
        )
        for scenario in distinct("--scenario", scenarios)
        for model, share, text, setting in losses
    ]
    legend: dict[str | float, str] = {"bernoulli": "independent", "bursts": f"in bursts of {burst_ticks:g} ticks"}
    return Experiment(name="loss", points=tuple(points), x=_LOSS_AXIS, curves="model", legend=legend)


def jitter(
    scenarios: Sequence[str], distributions: Sequence[str], deviations_s: Sequence[float], mean_s: float
) -> Experiment:
    """Return the sweep over random delays of different distributions with equal mean and standard deviation, s."""
    check_numbers("--mean", [mean_s], "a delay >= 0 s", 0.0)
    constant = [
        (NONE, 0.0, delay_s, f"constant {_ms(delay_s)}" if delay_s else "no delay", (f"links.delay_s={delay_s!r}",))
        for delay_s in dict.fromkeys((0.0, mean_s))
    ]
    random = []
    for distribution in distinct("--distribution", distributions):
        if distribution not in JITTER:
            raise refused("--distribution", f"one of {', '.join(JITTER)}", distribution)
        largest_s = mean_s / SMALLEST_MEAN[distribution]
        expected = f"a standard deviation from 0 to {largest_s:.3g} s ({distribution}, mean {mean_s:g} s)"
        check_numbers("--std", deviations_s, expected, 0.0, math.nextafter(largest_s, math.inf))
        unit, mean_of_unit = JITTER[distribution]
        for deviation_s in sorted(deviation_s for deviation_s in deviations_s if deviation_s > 0.0):
            scale_s = deviation_s / unit
            settings = (
                f"links.delay_s={max(0.0, mean_s - mean_of_unit * scale_s)!r}",
                f"links.jitter_s={max(0.0, scale_s)!r}",
                f"links.distribution={distribution}",
            )
            random.append((distribution, deviation_s, mean_s, f"{distribution} with {_ms(deviation_s)}", settings))
    points = [
        Point(
            scenario=scenario,
            labels={"distribution": distribution, "std_s": deviation_s, "mean_s": delay_s},
            text=text,
            settings=settings,
            baseline=delay_s == 0.0,
        )
        for scenario in distinct("--scenario", scenarios)
        for distribution, deviation_s, delay_s, text, settings in [*constant, *random]
    ]
    return Experiment(name="jitter", points=tuple(points), x=axis("std_s"), curves="distribution")


def matrix(scenarios: Sequence[str], delays_s: Sequence[float], shares: Sequence[float]) -> Experiment:
    """Return the sweep over every delay combined with every packet loss."""
    check_numbers("--delay", delays_s, "a delay >= 0 s", 0.0)
    check_numbers("--loss", shares, "a share from 0 to 1", 0.0, math.nextafter(1.0, 2.0))
    points = [
        Point(
            scenario=scenario,
            labels={"delay_s": delay_s, "loss": share},
            text=f"{_ms(delay_s)} and {_percent(share)} loss",
            settings=(f"links.delay_s={delay_s!r}", f"links.loss={share!r}"),
            baseline=delay_s == share == 0.0,
        )
        for scenario in distinct("--scenario", scenarios)
        for delay_s in sorted({0.0, *delays_s})
        for share in sorted({0.0, *shares})
    ]
    return Experiment(name="matrix", points=tuple(points), x=_DELAY_AXIS, y=_LOSS_AXIS, drawn_as="map")


def sharing(scenarios: Sequence[str], thresholds: Sequence[float], heartbeat_s: float) -> Experiment:
    """Return the sweep over thresholds of `controller.share` on each of `NETWORKS`.

    The baseline of each network sends all plans. A plan is sent if its corrections change by more than a threshold, a
    share of the input's range, or after the longest time without a plan, s.
    """
    check_numbers("--threshold", thresholds, "a share > 0", SMALLEST)
    check_numbers("--heartbeat", [heartbeat_s], "a time > 0 s", SMALLEST)
    on_change = ("controller.share=on_change", f"controller.share_heartbeat_s={heartbeat_s!r}")
    variants = [(0.0, "all plans sent", ("controller.share=always",))] + [
        (threshold, f"threshold {threshold:g}", (*on_change, f"controller.share_threshold={threshold!r}"))
        for threshold in sorted(thresholds)
    ]
    points = [
        Point(
            scenario=scenario,
            labels={"network": network, "share_threshold": threshold},
            text=f"{text}, {network}",
            settings=(*links, *settings),
            baseline=threshold == 0.0,
            group=network,
        )
        for scenario in distinct("--scenario", scenarios)
        for network, links in NETWORKS.items()
        for threshold, text, settings in variants
    ]
    return Experiment(name="sharing", points=tuple(points), x=_THRESHOLD_AXIS, curves="network", drawn_as="sharing")


def _bursts(share: float, burst_ticks: float) -> str:
    """Return the setting of a link that loses every plan in its bad state and spends a share of the ticks there."""
    leave = 1.0 / burst_ticks
    enter = leave * share / (1.0 - share)  # from share = enter / (enter + leave)
    if enter > 1.0:
        expected = f"at most {burst_ticks / (1.0 + burst_ticks):.3g} with bursts of {burst_ticks:g} ticks on average"
        raise refused("--loss", expected, f"{share:g}")
    return f"links.gilbert_elliott={{enter={enter!r},leave={leave!r},loss=1.0}}"


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:g} ms"


def _percent(share: float) -> str:
    return f"{100.0 * share:g} %"
