"""Relations of the radio's keys to each other and to the rest of a scenario."""

from transport.protocol.radio.standard import STANDARDS
from transport.protocol.scenario.fault_relations import Problems
from transport.protocol.scenario.schema import Scenario


def radio_problems(scenario: Scenario) -> Problems:
    """Yield what a team's radio cannot be, or cannot be together with."""
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

    exchange_s = controller.sampling_period_s / controller.negotiation_iterations
    computed_s = radio.computation_mean_s + 3.0 * radio.computation_deviation_s
    if radio.offsets == "slots" and computed_s >= exchange_s:
        expected = f"mean and three deviations below {exchange_s:g} s, the time of an exchange"
        yield "radio.computation_mean_s", f"{expected}, with offsets 'slots'", f"{computed_s:g} s"
