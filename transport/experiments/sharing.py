"""How many plans have to be sent: thresholds of `controller.share`, on a good and on a bad network."""

from collections.abc import Sequence

from transport.experiments.ablation import NETWORKS
from transport.experiments.cases import Point
from transport.experiments.catalogue import Axis, Experiment, check_numbers, distinct

ALWAYS = 0.0


def sharing(scenarios: Sequence[str], thresholds: Sequence[float], heartbeat_s: float) -> Experiment:
    """Every threshold on every network; each network is compared to itself with all plans sent.

    Args:
        scenarios: What is flown.
        thresholds: Changes of the corrections from which on a plan is sent, as shares of the input's range.
        heartbeat_s: A plan is sent at least that often, s.
    """
    check_numbers("--threshold", thresholds, "a share > 0", 5e-324, float("inf"))
    check_numbers("--heartbeat", [heartbeat_s], "a time > 0 s", 5e-324, float("inf"))
    on_change = ("controller.share=on_change", f"controller.share_heartbeat_s={heartbeat_s!r}")
    ways = [(ALWAYS, "all plans sent", ("controller.share=always",))] + [
        (threshold, f"threshold {threshold:g}", (*on_change, f"controller.share_threshold={threshold!r}"))
        for threshold in sorted(distinct("--threshold", thresholds))
    ]
    points = [
        Point(
            scenario=scenario,
            labels={"network": network, "share_threshold": threshold},
            text=f"{text}, {network}",
            settings=(*links, *settings),
            baseline=threshold == ALWAYS,
            group=network,
        )
        for scenario in distinct("--scenario", scenarios)
        for network, links in NETWORKS.items()
        for threshold, text, settings in ways
    ]
    return Experiment(name="sharing", points=tuple(points), x=Axis("share_threshold", "threshold"), drawn_as="tradeoff")
