"""Relations between the fields of links and radio, and those of the rest of a scenario."""

from collections.abc import Iterator

from transport.protocol.radio.standards_80211 import STANDARDS
from transport.protocol.scenario.faults.fault_relations import Problems, processes_of
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.wire.names import PLANT

# Deviations of the time of computing beyond its mean that a slot of the radio has to allow.
_LATEST_DEVIATIONS = 3.0


def link_problems(scenario: Scenario) -> Problems:
    """Yield empty partitions, and ends of links that are no processes of the run."""
    names = processes_of(scenario)
    agents = set(names) - {PLANT}
    for i, partition in enumerate(scenario.links.partition, start=1):
        if partition.end_s <= partition.start_s:
            expected = f"more than start_s {partition.start_s}"
            yield f"links.partition.{i}.end_s", expected, partition.end_s
        # The group is cut off from the agents that it lacks; all of them from none.
        if len(agents) > 1 and agents <= set(partition.between):
            expected = "some of the agents (no message at all: links.change with loss = 1.0)"
            yield f"links.partition.{i}.between", expected, "all of them"

    for field, name in _link_ends(scenario):
        if name is not None and name not in names:
            yield field, f"one of {', '.join(names)}", repr(name)


def _link_ends(scenario: Scenario) -> Iterator[tuple[str, str | None]]:
    """Yield the fields that name an end of a link, and the names."""
    links = scenario.links
    for key, sections in (("override", links.override), ("change", links.change)):
        for i, section in enumerate(sections, start=1):
            yield f"links.{key}.{i}.from", section.from_
            yield f"links.{key}.{i}.to", section.to
    for i, partition in enumerate(links.partition, start=1):
        for name in partition.between:
            yield f"links.partition.{i}.between", name


def radio_problems(scenario: Scenario) -> Problems:
    """Yield what a radio needs: lockstep, several agents, a rate of its standard, time to compute."""
    radio = scenario.radio
    controller = scenario.controller
    if radio is None:
        return
    if scenario.clock.mode == "realtime":
        yield "radio", "no such section with clock.mode = 'realtime': the network is real", "one"
    if len(scenario.owned) == 1:
        yield "radio", "several agents with it: one agent sends no plans", "one agent"

    rates_mbps = STANDARDS[radio.standard].rates_mbps
    if radio.rate_mbps not in rates_mbps:
        shown = ", ".join(f"{rate:g}" for rate in rates_mbps)
        yield "radio.rate_mbps", f"one of {shown} with {radio.standard}", f"{radio.rate_mbps:g}"

    if radio.inputs == "first" and controller.prediction != "closed_loop":
        expected = (
            "'all' without controller.prediction = 'closed_loop': the others predict with them"
        )
        yield "radio.inputs", expected, "'first'"
    if radio.inputs == "first" and set(scenario.controllers) != {"mpc"}:
        yield "radio.inputs", "'all' with a controller that is not 'mpc'", "'first'"

    exchange_s = controller.sampling_period_s / controller.negotiation_iterations
    computed_s = radio.computation_mean_s + _LATEST_DEVIATIONS * radio.computation_deviation_s
    if radio.offsets == "slots" and computed_s >= exchange_s:
        expected = f"mean and three deviations below {exchange_s:g} s, the time of an exchange"
        yield "radio.computation_mean_s", f"{expected}, with offsets 'slots'", f"{computed_s:g} s"

    if radio.cycle_ticks is not None and radio.offsets != "slots":
        expected = f"no value with radio.offsets = {radio.offsets!r}, which has no slots"
        yield "radio.cycle_ticks", expected, str(radio.cycle_ticks)
    if (radio.cycle_ticks or 1) > 1 and controller.negotiation_iterations > 1:
        iterations = f"controller.negotiation_iterations = {controller.negotiation_iterations}"
        expected = f"1 with {iterations}: each exchange has the slots of all agents"
        yield "radio.cycle_ticks", expected, str(radio.cycle_ticks)
