"""Runs and messages that the tests of protocol, nodes and runtimes share."""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from transport.experiments.weather_experiment import SENSORS
from transport.flight.memory import simulate
from transport.model import state
from transport.model.arrays import Array
from transport.protocol.network.bus_events_and_clock import Place
from transport.protocol.network.endpoints import Endpoints
from transport.protocol.scenario.scenario_file import read_scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import (
    STAGES,
    Control,
    Measurement,
    Message,
    Plan,
    PlantState,
    Roster,
    StepReport,
    Tick,
    agent_name,
)

SCENARIOS = Path(__file__).resolve().parents[2] / "scenarios"
PAPER = SCENARIOS / "paper.toml"

# Half a second of hover and a second of climb: 30 ticks, long enough for plans to differ from
# hover.
SHORT = (
    "maneuver.phase=[{name='hover',duration_s=0.5,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=1.0,displacement_m=[0,0,-0.5]}]"
)

# Sensors of the vehicles alone, with the noise of a small autopilot, and the filter that needs no
# more.
VEHICLE = (*SENSORS, "controller.prediction=closed_loop")

# One UAV in place of the paper's four, above the payload's centre of mass.
SINGLE_UAV = (
    "system.uav=[{id=1,mass_kg=1.5,inertia_kgm2=[0.029,0.029,0.055],rho_m=[0.0,0.0,-0.125],rod_length_m=3.2}]",
    "agents.owned=[[1]]",
    "controller.limits.thrust_N=[0.0,90.0]",
)

ALL = (1, 2, 3, 4)
INCARNATION = 1  # Of every agent: 0 is an earlier incarnation, 2 a later one.


def setup(*settings: str) -> Setup:
    """Return the run of the paper's scenario with some settings changed."""
    return ready("paper", *settings)


@lru_cache
def ready(name: str, *settings: str) -> Setup:
    """Return the run of a ready scenario with some settings changed."""
    path = SCENARIOS / f"{name}.toml"
    return Setup.of(read_scenario(path, settings), path.name)


def place(run: str) -> Place:
    """Return the place of a recorder in a run without a network."""
    return Place(run=run, endpoints=Endpoints(listen=[], connect=[]), join_timeout_s=1.0)


def integrated(run: Setup, x: Array, u: Array) -> Array:
    """Return the state one sampling period later, by the fewest equal steps of at most `plant.step_s`."""
    period_s, step_s = run.settings.sampling_period_s, run.scenario.plant.step_s
    return run.model.integrate(x, u, period_s, math.ceil(period_s / step_s - 1e-9))[0]


def ticks(count: int) -> str:
    """Return the setting of a hover of that many sampling periods."""
    return f"maneuver.phase=[{{name='hover',duration_s={0.05 * count},displacement_m=[0,0,0]}}]"


def recorded(
    run: Setup, flight: Callable[[Setup, Callable[[Message], None]], Control] = simulate
) -> list[Message]:
    """Return all messages of a run, in the order sent."""
    messages: list[Message] = []
    control = flight(run, messages.append)
    assert control.outcome == "completed", control
    return messages


def plant_states(messages: Sequence[Message]) -> list[PlantState]:
    """Return the plant states among messages, in order."""
    return [message for message in messages if isinstance(message, PlantState)]


def completed(run: Setup) -> list[Message]:
    """Return all messages of a run in memory, which has to be completed."""
    messages: list[Message] = []
    end = simulate(run, messages.append)
    assert end.outcome == "completed", end
    return messages


class _TickReachedError(Exception):
    """End of the part of a run that is simulated."""


def begun(run: Setup, tick: int) -> list[Message]:
    """Return the messages of all ticks before one, of a run in memory that ends there."""
    messages: list[Message] = []

    def record(message: Message) -> None:
        # All messages of the ticks before are recorded by then.
        if isinstance(message, PlantState) and message.tick == tick:
            raise _TickReachedError
        messages.append(message)

    with pytest.raises(_TickReachedError):
        simulate(run, record)
    return [message for message in messages if message.tick < tick]


def reproducible(message: Message) -> Message:
    """Return a message without its wall-clock times, the only difference between two equal runs."""
    return (
        replace(message, times_ms=np.zeros(len(STAGES)))
        if isinstance(message, StepReport)
        else message
    )


def tick(
    k: int, answered: Sequence[int] = ALL, members: Sequence[int] = ALL, version: int = 1
) -> Tick:
    """Return the coordinator's message that opens tick k."""
    return Tick(
        sender="coordinator",
        incarnation=0,
        sequence=k,
        tick=k,
        members=tuple(members),
        answered=tuple(answered) if k else (),
        shared=tuple(answered) if k else (),
        roster=version,
        late_ns=0,
        overrun_ns=0,
    )


def roster(incarnations: dict[int, int] | None = None, k: int = 0, version: int = 1) -> Roster:
    """Return the roster of some agents, by default of all four."""
    taking_part = dict.fromkeys(ALL, INCARNATION) if incarnations is None else incarnations
    return Roster(
        sender="coordinator",
        incarnation=0,
        sequence=0,
        tick=k,
        version=version,
        agents=tuple(taking_part),
        incarnations=tuple(taking_part.values()),
        off=(),
        released=(),
        reason="test",
    )


def end(k: int = 0) -> Control:
    """Return the coordinator's message that ends the run at tick k."""
    return Control(
        sender="coordinator",
        incarnation=0,
        sequence=9,
        tick=k,
        outcome="completed",
        reason="",
        exit_code=0,
    )


def measurement(
    run: Setup,
    agent: int,
    k: int,
    *,
    x: Array | None = None,
    answered: Sequence[int] = ALL,
    shared: Sequence[int] | None = None,
    version: int = 1,
) -> Measurement:
    """Return an agent's measurement of tick k: the given or the initial state, at hover inputs."""
    owned = list(run.owned[agent - 1])
    x = run.initial_state() if x is None else x
    return Measurement(
        sender="plant",
        incarnation=0,
        sequence=k,
        tick=k,
        agent=agent,
        answered=tuple(answered) if k else (),
        shared=tuple(answered if shared is None else shared) if k else (),
        roster=version,
        payload=x[: state.PAYLOAD],
        uavs=tuple(uav + 1 for uav in owned),
        uav_states=state.StateView(x).uavs[owned],
        inputs=run.hover.u.reshape(-1, state.INPUTS)[owned],
    )


def plan(
    run: Setup,
    agent: int,
    k: int,
    *,
    inputs: Array | None = None,
    delay: int = 0,
    x: Array | None = None,
    incarnation: int = INCARNATION,
    shared: bool = True,
) -> Plan:
    """Return an agent's plan of tick k that starts at k + delay, by default with hover inputs and the initial state."""
    owned = run.owned[agent - 1]
    x = run.initial_state() if x is None else x
    hover = np.tile(run.hover.u[state.input_indices(owned)], (run.settings.horizon, 1))
    return Plan(
        sender=agent_name(agent),
        incarnation=incarnation,
        sequence=2 * k,
        tick=k,
        agent=agent,
        start_tick=k + delay,
        negotiation=0,
        shared=shared,
        uavs=tuple(uav + 1 for uav in owned),
        uav_states=state.StateView(x).uavs[list(owned)],
        inputs=hover if inputs is None else inputs,
        corrections=hover[:0],
        status="solved",
    )


def plant_state(run: Setup, k: int, diverged: str = "") -> PlantState:
    """Return the plant state of tick k at hover."""
    return PlantState(
        sender="plant",
        incarnation=0,
        sequence=k,
        tick=k,
        x=run.initial_state(),
        u=run.hover.u,
        plan_ticks=tuple(k for _ in run.system.uavs),
        local_error=0.0,
        diverged=diverged,
    )
