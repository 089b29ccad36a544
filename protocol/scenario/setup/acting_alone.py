"""When UAVs of a run act alone, and by which gains: those designed for the team, or a refusal.

UAVs act alone by their controller, in silence, and on a fail-safe that follows.
"""

from collections.abc import Iterator

from transport.mpc.margins.design_of_gains_alone import DECAY_PER_S, AloneDesign
from transport.protocol.scenario.sections.link_sections import LinksSection
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.scenario.sections.schema import Scenario

_DEADLY = ("kill", "stop")


def may_act_alone(scenario: Scenario) -> bool:
    """Return whether UAVs can act alone, whatever happens in the run."""
    follows = scenario.controller.fail_safe == "follow"
    return "alone" in scenario.controllers or follows or hands_over(scenario)


def hands_over(scenario: Scenario) -> bool:
    """Return whether agents without information act alone."""
    controller = scenario.controller
    by_law = controller.prediction == "closed_loop" and "mpc" in scenario.controllers
    return by_law and controller.silence != "law" and len(scenario.owned) > 1


def check_design(scenario: Scenario, source: str, design: AloneDesign) -> None:
    """Refuse a run in which UAVs act alone, by what it says, and no gains hold the team.

    Raises: ScenarioError.
    """
    way = next(_ways(scenario), None)
    if not design.is_unstable or way is None:
        return
    grows = f"deviations that grow by {design.growth_per_s:.2g}/s at best"
    problem = f"expected gains with which UAVs alone hold this team {way}, got {grows}"
    remedies = "controller.silence=law, controller.fail_safe=level and agents.controller=mpc"
    raise ScenarioError(source, "controller.alone", f"{problem}; {remedies} do without")


def lacks(design: AloneDesign | None) -> Iterator[str]:
    """Yield what a design lacks, in words; nothing where it holds."""
    if design is None or design.holds:
        return
    if design.is_unstable:
        yield f"UAVs alone do not hold this team: deviations grow by {design.growth_per_s:.2g}/s"
    else:
        wanted = f"wanted is a decay of {DECAY_PER_S:g}/s, and some with a delay of 20 ms or a lag of 25 ms"
        yield f"UAVs alone hold this team without margins: {wanted}"


def _ways(scenario: Scenario) -> Iterator[str]:
    """Yield the ways in which UAVs of the run may act alone by what it says, in words."""
    is_real = scenario.clock.mode == "realtime"
    faults = [fault.do for fault in scenario.faults.event if fault.target.startswith("agent")]
    if "alone" in scenario.controllers:
        yield "(agents.controller=alone)"
    if hands_over(scenario):
        is_impaired = scenario.links != LinksSection() or scenario.radio is not None
        if is_impaired or is_real or scenario.controller.share == "on_change":
            yield "in silence"
    if scenario.controller.fail_safe == "follow":
        goes_on = scenario.clock.on_agent_loss == "continue"
        if goes_on or is_real or any(fault in _DEADLY for fault in faults):
            yield "on the fail-safe"
