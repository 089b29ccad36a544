"""Sections of a summary in words, a line each: limits, deadlines, plans, radio and solver."""

from collections.abc import Mapping, Sequence
from typing import Any

from transport.analysis.user_constraint_violations import HELD as OWN_HELD

# Violations below this share of a constraint's range are within the solver's tolerance.
HELD = 1e-6
# Limits that a UAV is at for a smaller share of the ticks are in the summary alone.
_TOLD_SHARE = 0.01
_MOST_TOLD = 4  # UAVs at a limit
_LOSSES = {
    "collisions": "lost by collisions",
    "weak": "too weak",
    "queue_drops": "dropped by queues",
    "given_up": "given up",
    "repetitions": "repetitions",
}


def number_text(value: float | None, sentence: str, otherwise: str = "-") -> str:
    """Return a sentence with a number; another one without it."""
    return otherwise if value is None else sentence.format(value)


def milliseconds(spread: Mapping[str, Any]) -> str:
    """Return median, 99th percentile and maximum of times, ms."""
    if spread["p50"] is None:
        return "-"
    return "median {p50:.2f} ms, p99 {p99:.2f} ms, max {max:.1f} ms".format(**spread)


def own_constraint_text(own: Mapping[str, Any]) -> str:
    """Return whether a constraint of the user held on the actual trajectory, and by how much not."""
    violation = own["violation_max"]
    softened = f", softened in {own['softened_steps']} steps" if own["softened_steps"] else ""
    if violation is not None and violation < OWN_HELD:
        return f"{own['expression']}: held{softened}"

    exceeded = number_text(violation, "exceeded by {:.3g}")
    return f"{own['expression']}: {exceeded} at {own['at_s']:.2f} s{softened}"


def limits_text(summary: Mapping[str, Any]) -> str:
    """Return whether the limits held: not if no controller saw to it, even if none was exceeded."""
    violation, solver = summary["constraint_violation_max"], summary["solver"]
    is_exceeded = violation is None or violation >= HELD
    exceeded = number_text(violation, "exceeded by {:.2%} of their range")
    worst = summary.get("constraint_violation")  # not in a summary of an earlier version
    if worst is not None:
        exceeded += f": {worst['limit']} at {worst['at_s']:.2f} s"

    if solver["beyond_share"]:
        excess = exceeded if is_exceeded else "none exceeded"
        exceeded = f"{excess}, but {solver['failures']} steps without a controller"
    elif not is_exceeded:
        exceeded = "held"
    return "; ".join([exceeded, *_reached_texts(summary.get("limits_reached", ()))])


def _reached_texts(reached: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return for each limit which UAVs were at it in how many of their ticks, the most first."""
    by_limit: dict[str, list[str]] = {}
    for one in reached:
        if one["share"] >= _TOLD_SHARE:
            by_limit.setdefault(one["limit"], []).append(f"UAV{one['uav']} {one['share']:.0%}")
    return [
        f"at the {limit} {', '.join(uavs[:_MOST_TOLD])} of the ticks"
        + (f", and {len(uavs) - _MOST_TOLD} more UAVs" if len(uavs) > _MOST_TOLD else "")
        for limit, uavs in by_limit.items()
    ]


def separation_text(summary: Mapping[str, Any]) -> str:
    """Return the smallest distance of two UAVs, and their first contact."""
    least = number_text(summary["separation_min_m"], "min {:.3f} m")
    contact = summary.get("collision")  # not in a summary of an earlier version
    if not contact:
        return least
    return "{}; UAV{} and UAV{} touch at {:.2f} s".format(least, *contact["uavs"], contact["at_s"])


def deadlines_text(deadline: Mapping[str, Any]) -> str:
    """Return how many plans missed their deadline, and how late ticks opened."""
    share = number_text(deadline["share"], "{:.2%}")
    missed = f"{deadline['missed']} of {deadline['plans']} missed ({share})"
    if deadline["missed"]:
        otherwise = "no plan of which arrived"
        worst = number_text(deadline["worst_ms"], "worst plan {:.1f} ms late", otherwise)
        missed += f", {worst}"
    return f"{missed}; ticks opened late: {milliseconds(deadline['tick_late_ms'])}"


def solver_text(solver: Mapping[str, Any]) -> str:
    """Return fallbacks and failed steps, with every agent that failed."""
    counts = "{fallbacks} fallbacks, {failures} failures".format(**solver)
    agents = ["agent{agent} {failures} of {steps}".format(**one) for one in solver["failed_agents"]]
    return f"{counts}: {', '.join(agents)}" if agents else counts


def plans_text(messages: Mapping[str, Any], ages: Mapping[str, Any]) -> str:
    """Return how many plans were sent, lost and late, and how old those in use were."""
    if ages["mean"] is None and not messages["sent"]:
        return "-"

    shared = messages["shared"]
    planned = messages["planned"]
    unsent = ""
    if shared < planned:
        unsent = f"{shared} of {planned} sent to the other agents ({shared / planned:.1%}); "

    lost = f"{messages['lost']} of {messages['sent']} lost"
    in_transit = messages.get("in_transit", 0)  # summaries of earlier versions lack it
    unarrived = f"{in_transit} not arrived at the end, " if in_transit else ""
    mean_age = number_text(ages["mean"], "{:.2f}")
    largest_age = number_text(ages["max"], "{:d}")
    age = f"age {mean_age} ticks, max {largest_age}"
    of_plant = [
        f"; {kind} {messages[kind]['lost']} of {messages[kind]['sent']} lost"
        for kind in ("measurements", "commands")
        if messages.get(kind, {}).get("lost")  # summaries of earlier versions lack them
    ]
    return f"{unsent}{lost}, {unarrived}{messages['late']} late; {age}{''.join(of_plant)}"


def radio_text(radio: Mapping[str, Any]) -> str:
    """Return airtime, deliveries, delays and losses of the team's radio."""
    airtime = number_text(radio["airtime_share"], "{:.1%}")
    delivered = number_text(radio["delivered_share"], "{:.1%}")
    parts = [
        f"{radio['rate_mbps']:g} Mb/s, {airtime} of the airtime",
        f"{delivered} delivered",
    ]
    delays = radio["delay_ms"]
    if delays["p50"] is not None:
        parts.append("delay median {p50:.1f} ms, p99 {p99:.1f} ms".format(**delays))
    parts += [f"{radio[key]} {words}" for key, words in _LOSSES.items() if radio[key]]
    if radio["replaced"]:
        parts.append(f"{radio['replaced']} replaced by newer ones before their slots")

    slots = radio["slots"]
    if slots is not None and slots["cycle_ticks"] > 1:
        parts.append(f"a slot for each agent every {slots['cycle_ticks']} ticks")
    too_short = short_slots_text(radio)
    return "; ".join([*parts, too_short] if too_short else parts)


def short_slots_text(radio: Mapping[str, Any]) -> str:
    """Return that slots are shorter than a plan on the air; empty if they are not."""
    slots = radio["slots"]
    if slots is None or slots["plan_ms"] <= slots["slot_ms"]:
        return ""
    return "slots of {slot_ms:.2f} ms are shorter than a plan, {plan_ms:.2f} ms".format(**slots)
