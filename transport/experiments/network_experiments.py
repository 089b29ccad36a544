"""Experiments with the network: delay, packet loss, jitter, and the number of plans that are sent."""

import math
from collections.abc import Iterator, Mapping, Sequence

from transport.experiments.cases import Point, refused
from transport.experiments.declaration import NONE, Values, declared
from transport.protocol.scenario.schema import Scenario

# Standard deviation of one unit of `links.jitter_s`, and the mean it adds, by distribution (docs/keys.md); and the
# smallest mean delay at which the random part is never cut off at zero, in standard deviations. The normal distribution
# has no such mean: 2 cut off 2 %. A lognormal number whose logarithm has unit variance has a mean of 1 / sqrt(e - 1)
# standard deviations.
_LOGNORMAL = 1.0 / math.sqrt(math.e - 1.0)
JITTER = {
    "uniform": (1.0 / math.sqrt(12.0), 0.0, math.sqrt(3.0)),
    "normal": (1.0, 0.0, 2.0),
    "exponential": (1.0, 1.0, 1.0),
    "lognormal": (1.0, _LOGNORMAL, _LOGNORMAL),
}

# A good and a bad network, with their settings.
NETWORKS: Mapping[str, tuple[str, ...]] = {
    "perfect": ("links.delay_s=0.0", "links.loss=0.0"),
    "200 ms delay, 30 % loss": ("links.delay_s=0.2", "links.loss=0.3"),
}


@declared("delay_s", delay=Values([0.0, 0.05, 0.1, 0.2, 0.4], "SECONDS", "Delay, s.", [0.0, 0.2]))
def latency(_: Scenario, delay: Sequence[float]) -> Iterator[Point]:
    """Effect of a fixed delay on every link.

    Example: transport experiment latency --delay 0.1 --delay 0.3 --scenario resilient
    """
    for delay_s in sorted({0.0, *delay}):
        yield Point(
            {"delay_s": delay_s},
            _ms(delay_s),
            (f"links.delay_s={delay_s!r}",),
            baseline=delay_s == 0.0,
        )


@declared(
    "loss",
    curves="model",
    legend={"bernoulli": "independent", "bursts": "in bursts"},
    seeds=5,
    loss=Values([0.1, 0.3, 0.6], "SHARE", "Packet loss.", [0.3]),
    burst=Values(5.0, "TICKS", "Mean length of a burst, ticks.", least=1.0),
)
def loss(_: Scenario, loss: Sequence[float], burst: float) -> Iterator[Point]:
    """Effect of packet loss, independent or in bursts.

    Example: transport experiment loss --loss 0.3 --burst 10
    """
    yield Point({"model": NONE, "loss": 0.0}, "no loss", ("links.loss=0.0",), baseline=True)
    for model, words in (("bernoulli", "at random"), ("bursts", "in bursts")):
        for share in filter(None, loss):
            setting = _bursts(share, burst) if model == "bursts" else f"links.loss={share!r}"
            yield Point({"model": model, "loss": share}, f"{_percent(share)} {words}", (setting,))


def _bursts(share: float, burst_ticks: float) -> str:
    """Return the setting of a link that loses every plan in its bad state and spends a share of the ticks there."""
    most = burst_ticks / (1.0 + burst_ticks)
    if share > most:
        raise refused(
            "--loss",
            f"at most {most:.3g} with bursts of {burst_ticks:g} ticks on average",
            f"{share:g}",
        )
    leave = 1.0 / burst_ticks
    enter = min(1.0, leave * share / (1.0 - share))  # from share = enter / (enter + leave)
    return f"links.gilbert_elliott={{enter={enter!r},leave={leave!r},loss=1.0}}"


@declared(
    "std_s",
    curves="distribution",
    seeds=3,
    distribution=Values(list(JITTER), "NAME", "Distribution.", ["uniform", "exponential"]),
    std=Values([0.02, 0.05, 0.08], "SECONDS", "Standard deviation of the delay, s.", [0.05]),
    mean=Values(0.16, "SECONDS", "Mean delay, s."),
)
def jitter(
    _: Scenario, distribution: Sequence[str], std: Sequence[float], mean: float
) -> Iterator[Point]:
    """Effect of the distribution of random delays.

    Several distributions with the same mean and standard deviation.

    Example: transport experiment jitter --std 0.05 --distribution lognormal
    """
    for delay_s in dict.fromkeys((0.0, mean)):
        yield Point(
            {"distribution": NONE, "std_s": 0.0, "mean_s": delay_s},
            f"constant {_ms(delay_s)}" if delay_s else "no delay",
            (f"links.delay_s={delay_s!r}",),
            baseline=delay_s == 0.0,
        )
    for name in distribution:
        if name not in JITTER:
            raise refused("--distribution", f"one of {', '.join(JITTER)}", name)
        unit, mean_of_unit, smallest = JITTER[name]
        for deviation_s in filter(None, std):
            if not 0.0 < deviation_s <= mean / smallest:
                expected = f"a standard deviation from 0 to {mean / smallest:.3g} s ({name}, mean {mean:g} s)"
                raise refused("--std", expected, f"{deviation_s:g}")
            scale_s = deviation_s / unit
            settings = (
                f"links.delay_s={max(0.0, mean - mean_of_unit * scale_s)!r}",
                f"links.jitter_s={scale_s!r}",
                f"links.distribution={name}",
            )
            labels: dict[str, str | float] = {
                "distribution": name,
                "std_s": deviation_s,
                "mean_s": mean,
            }
            yield Point(labels, f"{name} with {_ms(deviation_s)}", settings)


@declared(
    "delay_s",
    y="loss",
    seeds=3,
    delay=Values([0.0, 0.1, 0.2, 0.4], "SECONDS", "Delay, s.", [0.0, 0.2]),
    loss=Values([0.0, 0.1, 0.3, 0.6], "SHARE", "Packet loss.", [0.0, 0.3]),
)
def matrix(_: Scenario, delay: Sequence[float], loss: Sequence[float]) -> Iterator[Point]:
    """Maps of cost and completion over delay and loss.

    One map for each scenario: every delay with every loss.

    Example: transport experiment matrix --delay 0 --delay 0.2 --loss 0 --loss 0.3
    """
    for delay_s in sorted({0.0, *delay}):
        for share in sorted({0.0, *loss}):
            yield Point(
                {"delay_s": delay_s, "loss": share},
                f"{_ms(delay_s)} and {_percent(share)} loss",
                (f"links.delay_s={delay_s!r}", f"links.loss={share!r}"),
                baseline=delay_s == share == 0.0,
            )


@declared(
    "share_threshold",
    curves="network",
    drawn_as="sharing",
    scenarios=("resilient",),
    seeds=5,
    threshold=Values(
        [0.002, 0.005, 0.01, 0.02, 0.05],
        "SHARE",
        "Smallest change that is sent, share of the input's range.",
        [0.01],
    ),
    heartbeat=Values(1.0, "SECONDS", "Longest time between two plans, s."),
)
def sharing(_: Scenario, threshold: Sequence[float], heartbeat: float) -> Iterator[Point]:
    """Cost against the number of plans sent.

    On a perfect network and on one with 200 ms delay and 30 % packet loss.

    Simulates resilient by default: agents need the shared control law.

    Example: transport experiment sharing --threshold 0.01 --threshold 0.1
    """
    for network, links in NETWORKS.items():
        for least in (0.0, *threshold):  # the baseline of each network sends all plans
            on_change = (
                "controller.share=on_change",
                f"controller.share_heartbeat_s={heartbeat!r}",
                f"controller.share_threshold={least!r}",
            )
            yield Point(
                {"network": network, "share_threshold": least},
                f"threshold {least:g}, {network}" if least else f"all plans sent, {network}",
                (*links, *(on_change if least else ["controller.share=always"])),
                baseline=not least,
                group=network,
            )


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:g} ms"


def _percent(share: float) -> str:
    return f"{100.0 * share:g} %"
