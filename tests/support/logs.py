"""Logs composed of single messages and of simulated runs, for the tests of metrics, report and figures."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
import tomli_w
from msgspec.structs import replace

from tests.support import runs
from transport.agent.estimation.payload_pose import NAMES
from transport.flight.memory import simulate
from transport.log.run_log import LogTail, Recorded, RunLog
from transport.log.writer import LogWriter
from transport.model import state
from transport.model.arrays import Array
from transport.protocol.scenario.file import read_scenario
from transport.protocol.scenario.setup import Setup
from transport.protocol.wire.messages import (
    NO_NEWS,
    Airtime,
    FaultNote,
    Message,
    Note,
    Plan,
    PlantState,
    StepReport,
    agent_name,
)

M = TypeVar("M", bound=Message)

MILLISECOND_NS = 1_000_000

HEADER = {
    "run_id": "r1",
    "processes": "6",
    "seed": "0",
    "versions": "python 3.12.1, numpy 2.0.0",
    "machine": "a machine, 2 cores",
    "command_started_ns": "0",
}

# A single UAV above the payload's centre of mass.
SINGLE_UAV = (
    "system.uav=[{id=1,mass_kg=1.5,inertia_kgm2=[0.029,0.029,0.055],rho_m=[0.0,0.0,-0.125],rod_length_m=3.2}]",
    "agents.owned=[[1]]",
    "controller.limits.thrust_N=[0.0,90.0]",
)


def log_of(
    messages: Sequence[Message], received_ms: Sequence[float] = (), *, cut: str = ""
) -> RunLog:
    """Return a log of messages, received 1 ms apart unless `received_ms` is given."""
    times = list(received_ms) or [float(number) for number in range(len(messages))]
    entries = [
        Recorded(message=message, received_ns=round(at * MILLISECOND_NS))
        for message, at in zip(messages, times, strict=True)
    ]
    return RunLog(header=dict(HEADER), messages=tuple(entries), cut=cut)


def report(run: Setup, agent: int, tick: int, **fields: Any) -> StepReport:
    """Return an agent's report of a successful step."""
    peers = tuple(other for other in run.agents if other != agent)
    usual: dict[str, Any] = {
        "status": "solved",
        "solver": "daqp",
        "fallback": False,
        "iterations": 2,
        "residual": 1e-12,
        "peers": peers,
        "plan_ages": tuple(1 if tick else -1 for _ in peers),
        "state_ages": tuple(1 if tick else -1 for _ in peers),
        "measurement_age": 0,
        "delivered": len(peers) if tick else 0,
        "lost": 0,
        "late": 0,
        "force": np.zeros(3),
        "times_ms": np.array([0.6, 0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 1.5]),
    }
    return StepReport(
        sender=agent_name(agent),
        incarnation=0,
        sequence=tick,
        tick=tick,
        agent=agent,
        **(usual | fields),
    )


def plan(run: Setup, agent: int, k: int) -> Plan:
    """Return an agent's plan of tick k: two steps of hover."""
    owned = run.owned[agent - 1]
    return Plan(
        sender=agent_name(agent),
        incarnation=0,
        sequence=k,
        tick=k,
        agent=agent,
        start_tick=k,
        negotiation=0,
        shared=True,
        uavs=tuple(uav + 1 for uav in owned),
        uav_states=state.StateView(run.hover.x).uavs[list(owned)],
        inputs=np.tile(run.hover.u[state.input_indices(owned)], (2, 1)),
        corrections=np.empty((0, state.INPUTS * len(owned))),
        status="solved",
    )


def plant_state(
    run: Setup, k: int, change: Callable[[Array, Array], None] = lambda x, u: None
) -> PlantState:
    """Return the plant state at the reference of tick k with hover inputs, after `change` of copies of x and u."""
    times_s = np.array([k * run.settings.sampling_period_s])
    x = run.hover.x.copy()
    x[state.R0] += run.maneuver.path(times_s)[0][0]
    u = run.hover.u.copy()
    change(x, u)
    return replace(runs.plant_state(run, k), x=x, u=u)


def noted(run: Setup, agent: int, tick: int) -> Note:
    """Return a Kalman filter's note that errs by its standard deviation of 0.1 in each entry of the payload's pose."""
    estimate = run.hover.x[[0, 1, 2, 6, 7, 8]] + 0.1
    estimate[:3] += run.maneuver.path(np.array([tick * run.settings.sampling_period_s]))[0][0]
    values = np.concatenate([estimate, 0.01 * np.eye(6)[np.triu_indices(6)], [30.0, 15.0]])
    return Note(
        sender=f"agent{agent}", incarnation=0, sequence=tick, tick=tick, agent=agent, problem="", names=NAMES,
        values=values,
    )  # fmt: skip


def airtime(run: Setup, tick: int) -> Airtime:
    """Return news of a plan of agent 1 that arrived at agent 2 after 3 ms and was lost at agent 3."""
    arrivals = np.full((1, len(run.agents)), NO_NEWS)
    arrivals[0, 1:3] = 0.003, -1.0
    return Airtime(
        sender="coordinator", incarnation=0, sequence=tick, tick=tick, negotiation=0, agents=(1,),
        plan_ticks=(tick - 1,), exchanges=(0,), receivers=run.agents, sent=np.array([0.001]),
        arrivals=arrivals, busy_s=0.002, transmissions=1, repetitions=0,
    )  # fmt: skip


def with_scenario(header: Mapping[str, str], run: Setup) -> dict[str, str]:
    """Return the header of a log with the scenario of a run, by which its messages are checked."""
    return {**header, "scenario": tomli_w.dumps(run.scenario.tree())}


def record_run(run: Setup, folder: Path) -> list[Message]:
    """Simulate a run in this process, write its run folder as `transport run` does, and return all messages."""
    folder.mkdir(parents=True, exist_ok=True)
    text = tomli_w.dumps(run.scenario.tree())
    (folder / "scenario.toml").write_text(text, encoding="utf-8")
    messages: list[Message] = []
    with closing(
        LogWriter(folder / "run.mcap", HEADER | {"scenario": text}, period_ns=run.period_ns)
    ) as writer:

        def record(message: Message) -> None:
            messages.append(message)
            writer.write(message, len(messages) * MILLISECOND_NS)

        simulate(run, record)
    return messages


class Growing(LogTail):
    """Log of a live run, with all messages read so far."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._all: list[Message] = []

    def of(self, kind: type[M]) -> list[M]:
        """Return the messages of one kind so far."""
        self._all += self.read()
        return [message for message in self._all if isinstance(message, kind)]

    def notes(self, target: str, what: str) -> bool:
        """Return whether a fault of a process by a person is noted."""
        return any(
            (note.target, note.what, note.origin) == (target, what, "person")
            for note in self.of(FaultNote)
        )


class EnoughError(Exception):
    """End of the compared part of a run."""


def messages_until(tick: int, scenario: Path, setting: str) -> list[Message]:
    """Return the messages before a tick of a run in this process, without a viewer."""
    messages: list[Message] = []

    def record(message: Message) -> None:
        if isinstance(message, PlantState) and message.tick == tick:
            raise EnoughError
        messages.append(message)

    with pytest.raises(EnoughError):
        simulate(Setup.of(read_scenario(scenario, [setting]), str(scenario)), record)
    return [message for message in messages if message.tick < tick]


def bits(messages: Iterable[Message]) -> Iterator[tuple[int, str, bytes]]:
    """Return tick, sender and bytes of plant states and plans."""
    for message in messages:
        if isinstance(message, PlantState):
            yield message.tick, message.sender, message.x.tobytes() + message.u.tobytes()
        elif isinstance(message, Plan):
            yield (
                message.tick,
                message.sender,
                message.inputs.tobytes() + message.corrections.tobytes(),
            )
