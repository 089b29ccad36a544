"""The control laws that a run can get into, about hover: which, how fast deviations decay, and their margins.

The team's law, that of the team after the death of each agent, and UAVs alone.
"""

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass

import threadpoolctl

from transport.mpc.controller import Controller
from transport.mpc.margins.actual_plant import Mismatch
from transport.mpc.margins.loop_of_uavs_alone import AloneLoop
from transport.mpc.margins.sampled_loop import Loop, SampledLoop, margins
from transport.mpc.reference import Sampled
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.scenario.setup.run_setup import Setup

ACTUATIONS = ("immediate", "next_tick")
_FEEDBACK = "closed_loop, riccati, exact"  # prediction, terminal and discretisation
# Team size up to which the laws take seconds.
MOST_UAVS = 8
_TIMES = {"delay_s": "actuator delay", "lag_s": "motor lag"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Law:
    """A control law of a run about hover."""

    name: str
    settling_s: float | None  # in which the slowest deviation decays by e; None: one does not
    # Largest of each time in `_TIMES` with which deviations decay, s, beyond what is known; empty where one
    # grows, None where it is not computed: after a death it takes too long.
    margins_s: dict[str, float] | None = None


def laws(setup: Setup) -> Iterator[Law]:
    """Yield the laws that a run can get into, as far as they are known feedback."""
    actuation = ACTUATIONS[setup.scenario.clock.next_tick]
    with threadpoolctl.threadpool_limits(1):
        try:
            check_feedback(setup, ())
        except ScenarioError:
            pass
        else:
            yield _law("the team's law", team_loops(setup, ())[actuation])
            for agent in setup.agents if len(setup.agents) > 1 else ():
                loop = team_loops(setup, [agent])[actuation]
                settling_s = loop.settling_s(Mismatch(lag_s=loop.known_lag_s))
                yield Law(name=f"after the death of agent {agent}", settling_s=settling_s)
        if setup.alone is not None:
            yield _law("UAVs alone", alone_loops(setup)[actuation])


def in_words(setup: Setup) -> Iterator[str]:
    """Yield three lines about the laws of a run: which, the slowest decay, the smallest margins."""
    known = list(laws(setup))
    if not known:
        yield "laws: none of known feedback"
        return
    names = ["the team's"] if known[0].name == "the team's law" else []
    deaths = sum(law.name.startswith("after") for law in known)
    names += [f"{deaths} after a death"] if deaths else []
    names += [f"UAVs alone ({setup.alone.in_words()})"] if setup.alone else []
    yield f"laws: {', '.join(names)}"

    growing = [law.name for law in known if law.settling_s is None]
    slowest = max(known, key=lambda law: math.inf if law.settling_s is None else law.settling_s)
    time = "never" if growing else f"{slowest.settling_s:.2g} s"
    yield f"slowest decay: {time} ({', '.join(growing) or slowest.name})"

    parts = []
    for key, label in _TIMES.items():
        times_s = {
            law.name: law.margins_s.get(key, 0.0) for law in known if law.margins_s is not None
        }
        least = min(times_s, key=times_s.__getitem__)
        parts.append(f"{1e3 * times_s[least]:.0f} ms of {label} ({least})")
    yield f"smallest margins: {', '.join(parts)}"


def _law(name: str, loop: SampledLoop) -> Law:
    """Return a law by its loop."""
    known = Mismatch(lag_s=loop.known_lag_s)
    found = margins(loop, tuple(_TIMES))
    margins_s = {}
    for key, margin in found.items():
        upper_s = math.inf if margin.upper is None else margin.upper
        margins_s[key] = upper_s - margin.nominal
    return Law(name=name, settling_s=loop.settling_s(known), margins_s=margins_s)


def check_feedback(setup: Setup, absent: Collection[int]) -> None:
    """Refuse a controller whose plans are not a known feedback, and agents that cannot be gone.

    Raises: ScenarioError.
    """
    name = setup.scenario.name
    others = set(setup.scenario.controllers) - {"mpc"}
    if others:
        problem = f"expected 'mpc', whose feedback is known, got {', '.join(sorted(others))}"
        raise ScenarioError(name, "agents.controller", problem)
    if absent and not set(absent) < set(setup.agents):
        problem = f"expected some of {list(setup.agents)} gone, got {list(absent)}"
        raise ScenarioError(name, "agents", problem)

    settings = setup.settings
    got = f"{settings.prediction}, {settings.terminal}, {settings.discretisation}"
    if got != _FEEDBACK:
        problem = f"expected {_FEEDBACK}, whose plans are a feedback, got {got}"
        raise ScenarioError(name, "controller", problem)


def team_loops(setup: Setup, absent: Collection[int]) -> dict[str, Loop]:
    """Return the loop of the team without the absent agents, for each actuation."""
    present = [setup.owned[agent - 1] for agent in setup.agents if agent not in absent]
    gone = [uav for agent in absent for uav in setup.owned[agent - 1]]

    # About hover both linearisations are the same.
    settings = setup.settings.model_copy(update={"linearisation": "present"})
    reference = Sampled(X=setup.X_ref)
    team = [Controller(setup.model, setup.hover, settings, owned, reference) for owned in present]
    if gone:
        for controller in team:
            controller.without(gone)

    # Sampling periods from a state to its use by the other agents.
    delay_in_periods = setup.scenario.links.delay_s / settings.sampling_period_s
    age = max(1, math.ceil(delay_in_periods - 1e-9))
    fail_safe = setup.whole_team().law.fail_safe
    uncontrolled = {uav: fail_safe.gain(uav) for uav in gone}
    return {
        actuation: Loop(
            team, next_tick=actuation == "next_tick", age=age, uncontrolled=uncontrolled
        )
        for actuation in ACTUATIONS
    }


def alone_loops(setup: Setup) -> dict[str, AloneLoop]:
    """Return the loop of UAVs that all act alone for each actuation, with the gains for it."""
    loops = {}
    for actuation in ACTUATIONS:
        team = setup.team_alone(next_tick=actuation == "next_tick")
        loops[actuation] = team.loop(team.design().gains)
    return loops
