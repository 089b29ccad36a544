"""Messages for the log. Only the coordinator acts on them: it ends a diverged run."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from model.arrays import Array
from model.state import INPUTS, PAYLOAD, PER_UAV
from protocol.wire.control_loop import PlanStatus
from protocol.wire.fields import (
    Age,
    Agent,
    Ages,
    Count,
    Finite,
    Flag,
    Ids,
    MessageError,
    Name,
    Reason,
    Refusals,
    Shape,
    Text,
    integers,
)
from protocol.wire.message import Message, Route
from protocol.wire.names import AGENT, COORDINATOR, PLANT, RECORDER, WATCHER

FaultOrigin = Literal["script", "person", "unknown"]

# Stages of an agent's step: waiting for the measurement, the computation, publishing; the total is of the computation.
STAGES = ("wait", "estimate", "linearise", "discretise", "condense", "solve", "publish", "total")


@dataclass(frozen=True, slots=True, kw_only=True)
class StepReport(Message):
    """Agent to the record: one step, with the result of its solve.

    `times_ms` has the wall-clock time per stage, in the order of `STAGES`, (8,); "publish" is that of the step before.
    These times are not reproducible, unlike the rest.
    """

    kind: ClassVar[str] = "report"
    route: ClassVar[Route] = Route(sender=AGENT, receivers=(RECORDER, WATCHER), each="agent", grows="tick")

    agent: Agent
    status: PlanStatus
    solver: Text
    fallback: Flag
    iterations: Count
    residual: Finite  # the worst KKT residual, or -1 when there is none
    peers: Ids  # the other agents, ascending
    plan_ages: Ages  # age in ticks of the newest plan used of each of `peers`; -1 where none was ever received
    state_ages: Ages  # the same for the newest state of each
    measurement_age: Age  # the same for the newest measurement used
    delivered: Count  # plans of others that became usable at this tick
    lost: Count  # plans of earlier ticks that are known from now on to be lost on their link
    late: Count  # delivered plans that were older than one tick
    force: Annotated[Array, Shape(lambda _: (3,))]  # estimated, on the payload, inertial frame, N; or zero
    times_ms: Annotated[Array, Shape(lambda _: (len(STAGES),))]

    def _check_relations(self) -> None:
        for field, ages in (("plan_ages", self.plan_ages), ("state_ages", self.state_ages)):
            if len(ages) != len(self.peers):
                text = f"{field}: expected one for each of {len(self.peers)} peers, got {len(ages)}"
                raise MessageError("wrong_shape", text)


@dataclass(frozen=True, slots=True, kw_only=True)
class PlantState(Message):
    """Plant to the record and the coordinator: the true state at tick k and the inputs until k + 1.

    State x, (12 + 12 N,), SI; inputs u over [t_k, t_{k+1}), (4 N,), N and N m. `plan_ticks` has the tick of the plan
    each UAV's actuators followed, (N,): -1 before any plan, -2 for the fail-safe, -3 with the motors off.
    """

    kind: ClassVar[str] = "plant_state"
    route: ClassVar[Route] = Route(sender=PLANT, receivers=(COORDINATOR, RECORDER, WATCHER), grows="tick")

    x: Annotated[Array, Shape(lambda message: (PAYLOAD + PER_UAV * len(message.plan_ticks),))]
    u: Annotated[Array, Shape(lambda message: (INPUTS * len(message.plan_ticks),))]
    plan_ticks: Annotated[tuple[int, ...], integers(-3)]
    local_error: Finite  # largest local error estimate of the integration over the interval, SI
    diverged: Text  # empty, or why the run ends after this interval


@dataclass(frozen=True, slots=True, kw_only=True)
class ActualInputs(Message):
    """Plant to the record: mean of the actual inputs over [t_k, t_{k+1}), where the motors make them differ.

    Sent only in a run whose motors are not ideal. With those of `PlantState`, the commands, it explains the motion.
    """

    kind: ClassVar[str] = "actual_inputs"
    route: ClassVar[Route] = Route(sender=PLANT, receivers=(RECORDER,), grows="tick")

    uavs: Ids  # all of them, 1-based ids, ascending
    inputs: Annotated[Array, Shape(lambda message: (len(message.uavs), INPUTS))]  # (N, 4), N and N m


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultNote(Message):
    """Fault injected into a process, or a process that ended by itself; written to the log only, never sent."""

    kind: ClassVar[str] = "fault"
    route: ClassVar[Route] = Route(sender=RECORDER, receivers=())

    target: Name  # the process
    what: Text  # "killed", "stopped", "continued", "started" or how it ended
    origin: FaultOrigin  # the scenario's script, a person, or unknown to the recorder


@dataclass(frozen=True, slots=True, kw_only=True)
class Rejected(Message):
    """Any process to the record: it has refused messages. Sent only when there were any; not reproducible.

    Its sequence numbers count messages of this kind alone, so that they do not change those of the others.
    """

    kind: ClassVar[str] = "rejected"
    route: ClassVar[Route] = Route(sender=None, receivers=(RECORDER, WATCHER), each="sender")

    offender: Text  # sender according to the messages, or the key they came under
    reason: Reason  # why they were refused
    count: Refusals  # how many since the last message about this offender and reason
    example: Text  # the error of the first of all of them, for people
