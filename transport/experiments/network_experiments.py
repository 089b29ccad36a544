"""Experiments with the network: delay, packet loss, jitter, and the number of shared plans."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from transport.experiments.cases import Point, refused
from transport.experiments.declaration import NONE, Values, declared
from transport.protocol.scenario.sections.schema import Scenario


@dataclass(frozen=True, slots=True, kw_only=True)
class Jitter:
    """A distribution of random delays (docs/reference/keys.md).

    Attributes:
        deviation: Standard deviation of one unit of `links.jitter_s`.
        mean: Mean that one unit adds.
        least_mean: Smallest mean delay at which the random part is not cut off at zero, in standard
            deviations; of a normal distribution, 2 % are.
    """

    deviation: float
    mean: float
    least_mean: float


# Mean of a lognormal number whose logarithm has unit variance, in standard deviations.
_LOGNORMAL = 1.0 / math.sqrt(math.e - 1.0)
JITTER = {
    "uniform": Jitter(deviation=1.0 / math.sqrt(12.0), mean=0.0, least_mean=math.sqrt(3.0)),
    "normal": Jitter(deviation=1.0, mean=0.0, least_mean=2.0),
    "exponential": Jitter(deviation=1.0, mean=1.0, least_mean=1.0),
    "lognormal": Jitter(deviation=1.0, mean=_LOGNORMAL, least_mean=_LOGNORMAL),
}

_NO_JITTER = "links.jitter_s=0.0"
_NO_SAMPLES = "links.distribution=uniform"
_NO_LOSS = "links.loss=0.0"
_NO_BURSTS = "links.gilbert_elliott={enter=0.0,leave=1.0,loss=0.0}"

# A good and a bad network, with their settings.
NETWORKS: Mapping[str, tuple[str, ...]] = {
    "perfect": ("links.delay_s=0.0", "links.loss=0.0"),
    "200 ms delay, 30 % loss": ("links.delay_s=0.2", "links.loss=0.3"),
}


@declared(
    "delay_s", delay=Values([0.0, 0.05, 0.1, 0.2, 0.4], "SECONDS", "Delay, s.", quick=[0.0, 0.2])
)
def latency(scenario: Scenario, delay: Sequence[float]) -> Iterator[Point]:
    """Effect of a fixed delay on every link.

    Example: transport experiment latency --delay 0.1 --delay 0.3 --scenario resilient
    """
    for delay_s in sorted({0.0, *delay}):
        fixed = (f"links.delay_s={delay_s!r}", *without_jitter(scenario))
        yield Point({"delay_s": delay_s}, _ms(delay_s), fixed, baseline=delay_s == 0.0)


def without_jitter(scenario: Scenario) -> tuple[str, ...]:
    """Return the settings that take a scenario's own random delays away, if it has any.

    Raises: ExperimentError: the links are recorded ones.
    """
    _refuse_recorded(scenario)
    links = scenario.links
    settings = []
    if links.jitter_s != 0.0:
        settings.append(_NO_JITTER)
    if links.distribution == "empirical":
        settings.append(_NO_SAMPLES)
    return tuple(settings)


def _refuse_recorded(scenario: Scenario) -> None:
    """Refuse a scenario with recorded links: they have delays and losses of their own."""
    if scenario.links.trace is not None:
        expected = "none, as the experiment sets delays and losses"
        raise refused("links.trace", expected, f"{len(scenario.links.trace)} rows")


def without_bursts(scenario: Scenario) -> tuple[str, ...]:
    """Return the setting that takes a scenario's own bursts of loss away, if it has them.

    Raises: ExperimentError: the links are recorded ones.
    """
    _refuse_recorded(scenario)
    return () if scenario.links.gilbert_elliott is None else (_NO_BURSTS,)


@declared(
    "loss",
    curves="model",
    legend={"bernoulli": "independent", "bursts": "in bursts"},
    seeds=5,
    loss=Values([0.1, 0.3, 0.6], "SHARE", "Packet loss.", quick=[0.3]),
    burst=Values(5.0, "TICKS", "Mean length of a burst, ticks.", least=1.0),
)
def loss(scenario: Scenario, loss: Sequence[float], burst: float) -> Iterator[Point]:
    """Effect of packet loss, independent or in bursts.

    Example: transport experiment loss --loss 0.3 --burst 10
    """
    # A loss of the scenario's own is left out.
    no_bursts = without_bursts(scenario)
    no_loss = () if scenario.links.loss == 0.0 else (_NO_LOSS,)

    yield Point({"model": NONE, "loss": 0.0}, "no loss", (_NO_LOSS, *no_bursts), baseline=True)

    for share in filter(None, loss):  # no loss is the baseline above
        at_random = (f"links.loss={share!r}", *no_bursts)
        yield Point(
            {"model": "bernoulli", "loss": share}, f"{_percent(share)} at random", at_random
        )
    for share in filter(None, loss):
        in_bursts = (_bursts(share, burst), *no_loss)
        yield Point({"model": "bursts", "loss": share}, f"{_percent(share)} in bursts", in_bursts)


def _bursts(share: float, burst_ticks: float) -> str:
    """Return the setting of a link that loses every plan in its bad state.

    It spends a share of the ticks there.
    """
    # The largest share has enter = leave share / (1 - share) <= 1.
    if not burst_ticks < math.inf:
        raise refused("--burst", "a finite number of ticks", f"{burst_ticks:g}")
    most = burst_ticks / (1.0 + burst_ticks)
    if share > most:
        expected = f"at most {most:.3g} with bursts of {burst_ticks:g} ticks on average"
        raise refused("--loss", expected, f"{share:g}")

    # In equilibrium the bad state has the share enter / (enter + leave).
    leave = 1.0 / burst_ticks
    enter = min(1.0, leave * share / (1.0 - share))  # rounding may exceed 1
    return f"links.gilbert_elliott={{enter={enter!r},leave={leave!r},loss=1.0}}"


@declared(
    "std_s",
    curves="distribution",
    seeds=3,
    distribution=Values(list(JITTER), "NAME", "Distribution.", quick=["uniform", "exponential"]),
    std=Values([0.02, 0.05, 0.08], "SECONDS", "Standard deviation of the delay, s.", quick=[0.05]),
    mean=Values(0.16, "SECONDS", "Mean delay, s."),
)
def jitter(
    scenario: Scenario, distribution: Sequence[str], std: Sequence[float], mean: float
) -> Iterator[Point]:
    """Effect of the distribution of random delays.

    Several distributions with the same mean and standard deviation.

    Example: transport experiment jitter --std 0.05 --distribution lognormal
    """
    for delay_s in dict.fromkeys((0.0, mean)):
        yield Point(
            {"distribution": NONE, "std_s": 0.0, "mean_s": delay_s},
            f"constant {_ms(delay_s)}" if delay_s else "no delay",
            (f"links.delay_s={delay_s!r}", *without_jitter(scenario)),
            baseline=delay_s == 0.0,
        )

    for name in distribution:
        if name not in JITTER:
            raise refused("--distribution", f"one of {', '.join(JITTER)}", name)
        for deviation_s in filter(None, std):  # no deviation is the constant delay above
            yield Point(
                {"distribution": name, "std_s": deviation_s, "mean_s": mean},
                f"{name} with {_ms(deviation_s)}",
                _jitter_settings(name, deviation_s, mean),
            )


def _jitter_settings(name: str, deviation_s: float, mean_s: float) -> tuple[str, ...]:
    """Return the settings of a link whose delays have a mean and a standard deviation."""
    jitter = JITTER[name]
    most_s = mean_s / jitter.least_mean
    if not 0.0 < deviation_s <= most_s:
        limits = f"from 0 to {most_s:.3g} s ({name}, mean {mean_s:g} s)"
        raise refused("--std", f"a standard deviation {limits}", f"{deviation_s:g}")

    scale_s = deviation_s / jitter.deviation
    constant_s = max(0.0, mean_s - jitter.mean * scale_s)
    return (
        f"links.delay_s={constant_s!r}",
        f"links.jitter_s={scale_s!r}",
        f"links.distribution={name}",
    )


@declared(
    "delay_s",
    y="loss",
    seeds=3,
    delay=Values([0.0, 0.1, 0.2, 0.4], "SECONDS", "Delay, s.", quick=[0.0, 0.2]),
    loss=Values([0.0, 0.1, 0.3, 0.6], "SHARE", "Packet loss.", quick=[0.0, 0.3]),
)
def matrix(scenario: Scenario, delay: Sequence[float], loss: Sequence[float]) -> Iterator[Point]:
    """Maps of cost and completion over delay and loss.

    One map for each scenario: every delay with every loss, and none of either as the baseline.

    Example: transport experiment matrix --delay 0 --delay 0.2 --loss 0 --loss 0.3
    """
    only = (*without_jitter(scenario), *without_bursts(scenario))
    for delay_s in sorted({0.0, *delay}):
        for share in sorted({0.0, *loss}):
            yield Point(
                {"delay_s": delay_s, "loss": share},
                f"{_ms(delay_s)} and {_percent(share)} loss",
                (f"links.delay_s={delay_s!r}", f"links.loss={share!r}", *only),
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
        quick=[0.01],
    ),
    heartbeat=Values(1.0, "SECONDS", "Longest time between two plans, s."),
)
def sharing(scenario: Scenario, threshold: Sequence[float], heartbeat: float) -> Iterator[Point]:
    """Cost against the number of plans sent.

    On a perfect network and on one with 200 ms delay and 30 % packet loss.

    Simulates resilient by default: agents need the shared control law.

    Example: transport experiment sharing --threshold 0.01 --threshold 0.1
    """
    only = (*without_jitter(scenario), *without_bursts(scenario))
    for network, links in NETWORKS.items():
        # The baseline of each network sends all plans.
        for threshold_share in dict.fromkeys((0.0, *threshold)):
            shared: tuple[str, ...] = ("controller.share=always",)
            text = "all plans sent"
            if threshold_share:
                text = f"threshold {threshold_share:g}"
                shared = (
                    "controller.share=on_change",
                    f"controller.share_heartbeat_s={heartbeat!r}",
                    f"controller.share_threshold={threshold_share!r}",
                )
            yield Point(
                {"network": network, "share_threshold": threshold_share},
                f"{text}, {network}",
                (*links, *only, *shared),
                baseline=not threshold_share,
                group=network,
            )


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:g} ms"


def _percent(share: float) -> str:
    return f"{100.0 * share:g} %"
