"""Experiments with the network: delay, packet loss, jitter, and the number of plans that are sent."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from transport.experiments.cases import Point, refused
from transport.experiments.declaration import NONE, Axis, Experiment, Range, Values, axis, declared

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

DELAY = Range("a delay >= 0 s", 0.0)


def each(scenarios: Iterable[str], variants: Sequence[Point]) -> tuple[Point, ...]:
    """Return the points of a sweep whose variants are those of every scenario."""
    return tuple(replace(variant, scenario=name) for name in scenarios for variant in variants)


def _variant(labels: Mapping[str, str | float], text: str, *settings: str, baseline: bool, group: str = "") -> Point:
    """Return a point without its scenario."""
    return Point(scenario="", labels=labels, text=text, settings=settings, baseline=baseline, group=group)


@declared(
    delay=Values(
        [0.0, 0.05, 0.1, 0.2, 0.4], "SECONDS", "Delay, s; by default 0 to 0.4.", quick=[0.0, 0.2], within=DELAY
    )
)
def latency(scenarios: Iterable[str], delay: Sequence[float]) -> Experiment:
    """Effect of a fixed delay on every link.

    Example: transport experiment latency --delay 0.1 --delay 0.3 --scenario resilient
    """
    variants = [
        _variant({"delay_s": delay_s}, _ms(delay_s), f"links.delay_s={delay_s!r}", baseline=delay_s == 0.0)
        for delay_s in sorted({0.0, *delay})
    ]
    return Experiment(name="latency", points=each(scenarios, variants), x=_DELAY_AXIS)


@declared(
    defaults={"seeds": 5},
    loss=Values(
        [0.1, 0.3, 0.6],
        "SHARE",
        "Packet loss; by default 0.1, 0.3, 0.6.",
        quick=[0.3],
        within=Range("a share from 0 to below 1", 0.0, 1.0),
    ),
    burst=Values(5.0, "TICKS", "Mean length of a burst, ticks.", within=Range("a mean length >= 1 tick", 1.0)),
)
def loss(scenarios: Iterable[str], loss: Sequence[float], burst: float) -> Experiment:
    """Effect of packet loss, independent or in bursts.

    Example: transport experiment loss --loss 0.3 --burst 10
    """
    lossy = sorted(share for share in loss if share > 0.0)
    losses = [
        (NONE, 0.0, "no loss", "links.loss=0.0"),
        *(("bernoulli", share, f"{_percent(share)} at random", f"links.loss={share!r}") for share in lossy),
        *(("bursts", share, f"{_percent(share)} in bursts", _bursts(share, burst)) for share in lossy),
    ]
    variants = [
        _variant({"model": model, "loss": share}, text, setting, baseline=model == NONE)
        for model, share, text, setting in losses
    ]
    legend: dict[str | float, str] = {"bernoulli": "independent", "bursts": f"in bursts of {burst:g} ticks"}
    return Experiment(name="loss", points=each(scenarios, variants), x=_LOSS_AXIS, curves="model", legend=legend)


def _bursts(share: float, burst_ticks: float) -> str:
    """Return the setting of a link that loses every plan in its bad state and spends a share of the ticks there."""
    leave = 1.0 / burst_ticks
    enter = leave * share / (1.0 - share)  # from share = enter / (enter + leave)
    if enter > 1.0:
        expected = f"at most {burst_ticks / (1.0 + burst_ticks):.3g} with bursts of {burst_ticks:g} ticks on average"
        raise refused("--loss", expected, f"{share:g}")
    return f"links.gilbert_elliott={{enter={enter!r},leave={leave!r},loss=1.0}}"


@declared(
    defaults={"seeds": 3},
    distribution=Values(
        list(JITTER),
        "NAME",
        "uniform, normal, exponential, lognormal; by default all.",
        quick=["uniform", "exponential"],
    ),
    std=Values(
        [0.02, 0.05, 0.08], "SECONDS", "Standard deviation of the delay, s; by default 0.02, 0.05, 0.08.", quick=[0.05]
    ),
    mean=Values(0.16, "SECONDS", "Mean delay, s.", within=DELAY),
)
def jitter(scenarios: Iterable[str], distribution: Sequence[str], std: Sequence[float], mean: float) -> Experiment:
    """Effect of the distribution of random delays.

    Several distributions with the same mean and standard deviation.

    Example: transport experiment jitter --std 0.05 --distribution lognormal
    """
    found: list[tuple[str, float, float, str, tuple[str, ...]]] = [
        (NONE, 0.0, delay_s, f"constant {_ms(delay_s)}" if delay_s else "no delay", (f"links.delay_s={delay_s!r}",))
        for delay_s in dict.fromkeys((0.0, mean))
    ]
    for name in distribution:
        if name not in JITTER:
            raise refused("--distribution", f"one of {', '.join(JITTER)}", name)
        largest_s = mean / SMALLEST_MEAN[name]
        expected = f"a standard deviation from 0 to {largest_s:.3g} s ({name}, mean {mean:g} s)"
        Range(expected, 0.0, math.nextafter(largest_s, math.inf)).check("--std", *std)
        unit, mean_of_unit = JITTER[name]
        for deviation_s in sorted(deviation_s for deviation_s in std if deviation_s > 0.0):
            scale_s = deviation_s / unit
            settings = (
                f"links.delay_s={max(0.0, mean - mean_of_unit * scale_s)!r}",
                f"links.jitter_s={max(0.0, scale_s)!r}",
                f"links.distribution={name}",
            )
            found.append((name, deviation_s, mean, f"{name} with {_ms(deviation_s)}", settings))
    variants = [
        _variant(
            {"distribution": name, "std_s": deviation_s, "mean_s": delay_s}, text, *settings, baseline=delay_s == 0.0
        )
        for name, deviation_s, delay_s, text, settings in found
    ]
    return Experiment(name="jitter", points=each(scenarios, variants), x=axis("std_s"), curves="distribution")


@declared(
    defaults={"seeds": 3},
    delay=Values(
        [0.0, 0.1, 0.2, 0.4], "SECONDS", "Delay, s; by default 0, 0.1, 0.2, 0.4.", quick=[0.0, 0.2], within=DELAY
    ),
    loss=Values(
        [0.0, 0.1, 0.3, 0.6],
        "SHARE",
        "Packet loss; by default 0, 0.1, 0.3, 0.6.",
        quick=[0.0, 0.3],
        within=Range("a share from 0 to 1", 0.0, math.nextafter(1.0, 2.0)),
    ),
)
def matrix(scenarios: Iterable[str], delay: Sequence[float], loss: Sequence[float]) -> Experiment:
    """Maps of cost and completion over delay and loss.

    One map for each scenario: every delay with every loss.

    Example: transport experiment matrix --delay 0 --delay 0.2 --loss 0 --loss 0.3
    """
    variants = [
        _variant(
            {"delay_s": delay_s, "loss": share},
            f"{_ms(delay_s)} and {_percent(share)} loss",
            f"links.delay_s={delay_s!r}",
            f"links.loss={share!r}",
            baseline=delay_s == share == 0.0,
        )
        for delay_s in sorted({0.0, *delay})
        for share in sorted({0.0, *loss})
    ]
    points = each(scenarios, variants)
    return Experiment(name="matrix", points=points, x=_DELAY_AXIS, y=_LOSS_AXIS, drawn_as="map")


@declared(
    scenarios=("resilient",),
    defaults={"seeds": 5},
    threshold=Values(
        [0.002, 0.005, 0.01, 0.02, 0.05],
        "SHARE",
        "Smallest change that is sent, share of the input's range.",
        quick=[0.01],
        within=Range("a share > 0"),
    ),
    heartbeat=Values(1.0, "SECONDS", "Longest time between two plans, s.", within=Range("a time > 0 s")),
)
def sharing(scenarios: Iterable[str], threshold: Sequence[float], heartbeat: float) -> Experiment:
    """Cost against the number of plans sent.

    On a perfect network and on one with 200 ms delay and 30 % packet loss.

    Simulates resilient by default: agents need the shared control law.

    Example: transport experiment sharing --threshold 0.01 --threshold 0.1
    """
    on_change = ("controller.share=on_change", f"controller.share_heartbeat_s={heartbeat!r}")
    shared = [(0.0, "all plans sent", ("controller.share=always",))] + [
        (least, f"threshold {least:g}", (*on_change, f"controller.share_threshold={least!r}"))
        for least in sorted(threshold)
    ]
    variants = [
        _variant(  # the baseline of each network sends all plans
            {"network": network, "share_threshold": least},
            f"{text}, {network}",
            *links,
            *settings,
            baseline=least == 0.0,
            group=network,
        )
        for network, links in NETWORKS.items()
        for least, text, settings in shared
    ]
    points = each(scenarios, variants)
    return Experiment(name="sharing", points=points, x=_THRESHOLD_AXIS, curves="network", drawn_as="sharing")


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:g} ms"


def _percent(share: float) -> str:
    return f"{100.0 * share:g} %"
