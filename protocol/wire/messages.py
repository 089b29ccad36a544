"""All messages of a run (docs/reference/protocol.md), and the other events that nodes receive."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np
from msgspec import Meta

from transport.model.arrays import Array, frozen
from transport.model.state import INPUTS, PAYLOAD, PER_UAV, REPORTED, REPORTS, SENSED
from transport.protocol.wire.errors_and_exit_codes import MessageError, Reason
from transport.protocol.wire.message_form import (
    MAX_DATA,
    MAX_HORIZON,
    MAX_NEGOTIATION_ITERATIONS,
    MAX_POINTS,
    MAX_TICK,
    SOLID,
    Age,
    Agent,
    Ages,
    Carried,
    Count,
    Counts,
    Finite,
    Ids,
    Instants,
    Message,
    Names,
    PlanTicks,
    Route,
    Rows,
    Sensors,
    ShapeOf,
    Text,
    kinds_below,
)
from transport.protocol.wire.names import (
    AGENT,
    COORDINATOR,
    PLANT,
    RECORDER,
    VEHICLE,
    WATCHER,
    agent_name,
)

# In `Airtime.arrivals`: a newer plan took the place of this one before it was sent.
REPLACED = -5.0
UNREPORTED = -9.0
CONTINUED = "continued"  # in `FaultNote.what`, by which a replay knows the process

Outcome = Literal["completed", "failed", "diverged", "aborted", "collided"]
PlanStatus = Literal["solved", "infeasible", "limit", "numerical", "unchanged"]
FaultOrigin = Literal["script", "person", "unknown"]

# Stages of an agent's step: waiting for the measurement, the computation, publishing; the total is
# of the computation.
STAGES = ("wait", "estimate", "linearise", "discretise", "condense", "solve", "publish", "total")

_ALL_BUT_COORDINATOR = (AGENT, PLANT, VEHICLE, RECORDER, WATCHER)


def _per_uav(numbers: int) -> ShapeOf:
    return lambda message: (len(message.uavs), numbers)


def _states_or(sensed: int) -> ShapeOf:
    """States of the message's UAVs, or that many numbers of their own sensors, each.

    A run has either; the array itself tells which.
    """
    return lambda message: (
        len(message.uavs),
        sensed if message.uav_states.shape[-1:] == (sensed,) else PER_UAV,
    )


def _steps(message: Any) -> tuple[int | None, ...]:
    return None, INPUTS * len(message.uavs)


# From the coordinator


class Tick(Message, tag="tick", frozen=True, kw_only=True):
    """Coordinator to plant: tick k is open."""

    route: ClassVar[Route] = Route(
        sender=COORDINATOR, receivers=(PLANT, RECORDER, WATCHER), grows="tick"
    )

    members: Ids  # agents whose plans of this tick the clock will wait for
    # Agents whose plans of tick k - 1 had arrived when tick k opened: users of them wait for these.
    answered: Ids
    shared: Ids  # those of them that sent the plan to the other agents as well
    roster: Count  # version of the roster in force: a receiver with an older one waits for it
    late_ns: Count  # in real time, how long after its deadline the tick was opened; else 0
    # In real time, by how much the latest plan received since the last tick missed its deadline,
    # the opening of the tick after its own; else 0.
    overrun_ns: Count


class Roster(Message, tag="roster", frozen=True, kw_only=True):
    """Coordinator to all: the agents that take part from this tick on."""

    route: ClassVar[Route] = Route(
        sender=COORDINATOR, receivers=_ALL_BUT_COORDINATOR, grows="version"
    )
    as_long: ClassVar[tuple[str, ...]] = "agents", "incarnations"

    version: Count  # grows with every change
    agents: Ids  # agents on the roster
    # Their incarnations, in the same order; messages of other incarnations are refused.
    incarnations: Counts
    # UAVs whose motors give no thrust and no moments, 1-based ids, ascending; the released ones
    # too.
    off: Ids
    released: Ids  # UAVs that are no longer on their rods, 1-based ids, ascending
    reason: Text  # why it changed, for people


class LinkChange(Message, tag="link", frozen=True, kw_only=True):
    """Coordinator to all: from this tick on links differ.

    It has the key of the roster, so that it arrives before the next one.
    """

    route: ClassVar[Route] = Route(sender=COORDINATOR, receivers=_ALL_BUT_COORDINATOR, key="roster")

    # Of the change in its run: a process that joins late receives all of them again.
    number: Annotated[int, Meta(ge=1)]
    source: str  # name of an end; empty for any agent
    target: str  # the same
    # Keys of a link and their new values, a JSON object (docs/reference/keys.md, `links`).
    settings: Text


class Target(Message, tag="target", frozen=True, kw_only=True):
    """Coordinator to all, or to some agents: from this tick on the payload leaves its path for a target.

    Further points make a curve that begins at the target.
    """

    route: ClassVar[Route] = Route(sender=COORDINATOR, receivers=_ALL_BUT_COORDINATOR, key="roster")
    shapes: ClassVar[Mapping[str, ShapeOf]] = {
        "points": lambda _: (None, 3),
        "times": lambda one: (len(one.points),),
    }
    as_long: ClassVar[tuple[str, ...]] = "informed", "got"
    optional: ClassVar[tuple[str, ...]] = ("lands", "to", "informed", "got", "begins", "brakes")

    # Of the target in its run; sent again to processes that join late.
    number: Annotated[int, Meta(ge=1)]
    points: Array  # the target and further way points, (k, 3), inertial frame, m
    # Times of the points since the target is reached, (k,), s; zeros where one speed holds.
    times: Array
    approach_s: Finite  # time until the target is reached
    approach_ramp_s: Finite  # time of speeding up, and of slowing down; at most half of it
    way_s: Finite  # time from the target to the last point; 0 without further points
    way_ramp_s: Finite
    lands: bool = False  # whether the last point is on the ground
    # Agents that are told, ascending; the others learn it from plans. Empty: all are told.
    to: Ids = ()
    # In plans of runs that confirm targets: agents that are known to have it, the tick at which each
    # got it, and once it is followed, the tick from which on; else empty, and 0.
    informed: Ids = ()
    got: Counts = ()
    begins: Count = 0
    # Whether the payload brakes along the path before, within the time of the approach: targets that agents make.
    brakes: bool = False

    @property
    def first_tick(self) -> int:
        """Tick from which on the path leads to it: when it was told, or when all had it.

        Braking begins at its own tick, and `begins` is that of the way from the rest on.
        """
        return self.tick if self.brakes else self.begins or self.tick

    def in_words(self) -> str:
        """Return the target in words."""
        x, y, z = self.points[-1 if self.lands else 0].tolist()
        told = f", told to {', '.join(map(agent_name, self.to))}" if self.to else ""
        return f"{'landing' if self.lands else 'target'} ({x:g}, {y:g}, {z:g}) m{told}"

    def check(self) -> None:
        """Check the number of points."""
        Message.check(self)
        if not 1 <= len(self.points) <= MAX_POINTS:
            raise MessageError(
                "wrong_shape", f"points: expected 1 to {MAX_POINTS}, got {len(self.points)}"
            )


class Control(Message, tag="control", frozen=True, kw_only=True):
    """Coordinator to all: the run ends here."""

    route: ClassVar[Route] = Route(sender=COORDINATOR, receivers=_ALL_BUT_COORDINATOR)

    outcome: Outcome
    reason: Text  # why, for people; empty when completed
    exit_code: Annotated[int, Meta(ge=0, le=255)]  # the code every process exits with


class Airtime(Message, tag="airtime", frozen=True, kw_only=True):
    """Coordinator to agents: what the radio of the team did with their plans until this tick, or an exchange of it.

    The numbers of a frame count in seconds from the tick of its plan.
    """

    route: ClassVar[Route] = Route(sender=COORDINATOR, receivers=(AGENT, PLANT, RECORDER, WATCHER))
    as_long: ClassVar[tuple[str, ...]] = "agents", "plan_ticks", "exchanges"
    shapes: ClassVar[Mapping[str, ShapeOf]] = {
        "sent": lambda one: (len(one.agents),),
        "arrivals": lambda one: (len(one.agents), len(one.receivers)),
    }

    # Exchanges that follow within the tick, as in proposals of a negotiation; 0: the tick is open.
    negotiation: Annotated[int, Meta(ge=0, le=MAX_NEGOTIATION_ITERATIONS - 1)]
    agents: Rows  # sender of each reported plan, 1-based
    plan_ticks: Rows  # its tick
    exchanges: Rows  # its own `negotiation`
    receivers: Ids  # the agents of the run, ascending
    sent: Array  # instant at which its sender put it into the queue, (F,), s
    # Instant of its arrival at each agent, (F, receivers), s, or why it was lost: -1 collision, -2 too
    # weak, -3 queue full, -4 attempts exhausted; -5: never sent, a newer one has its slot; -9: nothing
    # new, or the agent is no receiver.
    arrivals: Array
    busy_s: Finite  # air occupied since the last report, s
    transmissions: Count  # of frames since the last report
    repetitions: Count  # those of them that repeat a frame that was not acknowledged

    def of_sent(self) -> Array:
        """Return the arrivals and losses of plans that were sent, (K,), as in `arrivals`."""
        is_decided = (self.arrivals != UNREPORTED) & (self.arrivals != REPLACED)
        return np.asarray(self.arrivals[is_decided])


class Schedule(Message, tag="schedule", frozen=True, kw_only=True):
    """Coordinator to plant and vehicles: the instants of the ticks, on the common clock.

    Tick k is at `start_ns` + k T_s / speed for every process, also without a coordinator.
    """

    route: ClassVar[Route] = Route(
        sender=COORDINATOR, receivers=(PLANT, VEHICLE, RECORDER, WATCHER)
    )
    optional: ClassVar[tuple[str, ...]] = ("targets", "links")

    sent_ns: Instants  # when the coordinator sent this, by its clock
    start_ns: Instants  # of tick 0; 0 while vehicles are still preparing
    # Targets and changes of links that the coordinator knows: one that has returned lacks earlier ones.
    targets: Count = 0
    links: Count = 0


# The control loop


class VehicleStatus(Message, tag="vehicle", frozen=True, kw_only=True):
    """Vehicle to coordinator, the other vehicles and the record: how its UAV is.

    At each tick, and some times a second before the first.
    """

    route: ClassVar[Route] = Route(
        sender=VEHICLE,
        number="uav",
        receivers=(COORDINATOR, PLANT, VEHICLE, RECORDER, WATCHER),
        each="sender",
    )
    shapes: ClassVar[Mapping[str, ShapeOf]] = {"position": lambda _: (3,)}
    optional: ClassVar[tuple[str, ...]] = ("targets", "links", "changes")

    uav: Agent
    phase: Text  # see `vehicle.phases`
    problem: Text  # what keeps it from going on, or has happened; empty for nothing
    armed: bool
    mode: Text  # of the autopilot
    battery: Finite  # share that is left; -1 where it is not known
    healthy: bool  # whether the autopilot believes its estimate
    position: Array  # by its estimate, (3,), common frame, m; zeros before one
    age_s: Finite  # of the measurements at the tick; -1 before there are some
    # Tick of the plan that it follows: -1 before any, -2 for its own law, -3 without setpoints.
    plan_tick: Annotated[int, Meta(ge=-3, le=MAX_TICK)]
    latency_s: Finite  # from the arrival of that plan to its first setpoint; -1 for none
    late_s: Finite  # largest delay of a setpoint after its instant since the last status
    roster: Count  # version of the newest roster that it has
    # For the offset of clocks: `Schedule.sent_ns` of the newest, when it arrived, when this was sent.
    heard_ns: Instants
    heard_at_ns: Instants
    sent_ns: Instants
    start_ns: Instants  # of the ticks that it follows; 0 before
    targets: Count = 0  # that it knows
    links: Count = 0  # changes of them that it knows
    # `target` and `link` messages that another process lacks (`protocol.admission.told_changes`).
    changes: Carried = ()


_NO_SOLIDS = np.zeros((0, SOLID))
frozen(_NO_SOLIDS)


class Measurement(Message, tag="measurement", frozen=True, kw_only=True):
    """Plant, or vehicle, to one agent: the measurements of tick k. It opens the tick for that agent."""

    route: ClassVar[Route] = Route(
        sender=PLANT,
        receivers=(AGENT, RECORDER),
        each="agent",
        grows="tick",
        by_vehicles=True,
    )
    shapes: ClassVar[Mapping[str, ShapeOf]] = {
        "payload": lambda message: (0 if message.uav_states.shape[-1:] == (SENSED,) else PAYLOAD,),
        "uav_states": _states_or(SENSED),
        "inputs": _per_uav(INPUTS),
        "seen": lambda _: (None, SOLID),
    }
    optional: ClassVar[tuple[str, ...]] = ("missing", "seen")

    agent: Agent  # the agent it is for
    answered: Ids  # these three as in the tick
    shared: Ids
    roster: Count
    payload: Array  # states r0, v0, Theta0, omega0, (12,), SI; (0,) with `plant.sensors` vehicle
    uavs: Ids  # owned UAVs, 1-based ids, ascending
    # Their states e, Omega, Theta, omega, (owned, 12), SI; with `plant.sensors` vehicle the
    # measurements of their sensors, r, v, Theta, omega, specific force, (owned, 15), SI.
    uav_states: Array
    inputs: Array  # commands in force until now, (owned, 4), N and N m or rad/s
    # Sensors of each UAV that have no measurement, as bits (`model.state.SENSORS`); their numbers
    # are zeros. Empty if all have one.
    missing: Sensors = ()
    # Solids of obstacles that only sight tells and that are near one of these UAVs, (k, 11): number of the
    # obstacle in the scenario, from 1; centre, inertial frame, m; heading, rad; half sizes, m, 10^6 without
    # ends; radius, margins of UAVs and of the load, m.
    seen: Array = msgspec.field(default_factory=lambda: _NO_SOLIDS)

    def check(self) -> None:
        """Check the arrays, that missing sensors are of all UAVs."""
        Message.check(self)
        if len(self.missing) not in (0, len(self.uavs)):
            expected = f"none or one for each of {len(self.uavs)} uavs"
            text = f"missing: expected {expected}, got {len(self.missing)}"
            raise MessageError("wrong_shape", text)


_NO_NUMBERS = np.zeros(0)
frozen(_NO_NUMBERS)


class Plan(Message, tag="plan", frozen=True, kw_only=True):
    """Agent to plant and coordinator: states of its UAVs and inputs to apply.

    To the other agents too, if it is shared.
    """

    route: ClassVar[Route] = Route(
        sender=AGENT,
        receivers=(AGENT, COORDINATOR, PLANT, VEHICLE, RECORDER),
        each="agent",
        unshared_key="unshared",
        grows="tick",
        falls="negotiation",
    )
    shapes: ClassVar[Mapping[str, ShapeOf]] = {
        "uav_states": _states_or(REPORTS * REPORTED),
        "inputs": _steps,
        "corrections": _steps,
        "data": lambda _: (None,),
    }
    optional: ClassVar[tuple[str, ...]] = ("data", "stale", "targets", "lag")

    agent: Agent  # the agent that planned
    start_tick: Count  # first sampling instant the inputs are for
    # Exchanges that follow within the tick.
    negotiation: Annotated[int, Meta(ge=0, le=MAX_NEGOTIATION_ITERATIONS - 1)]
    shared: bool  # whether the other agents receive it: it travels under another key if not
    uavs: Ids  # owned UAVs, 1-based ids, ascending
    # Their states at `tick`, (owned, 12), SI; with `plant.sensors` vehicle the measurements and
    # inputs of the last four ticks, (owned, 80): the loss of one plan loses no measurement
    # (`model.state.REPORTED`).
    uav_states: Array
    # Absolute inputs per step from `start_tick` on, (steps, 4 owned), N and N m or rad/s.
    inputs: Array
    # Corrections of these inputs to the shared control law, (steps, 4 owned); no rows without one.
    corrections: Array
    # Result of the solve. "unchanged": a class of the user returned the same as for some time, whatever
    # it measured. Any other but "solved" means the shifted previous plan.
    status: PlanStatus
    # How much of the inputs is of the control law of a UAV alone, not of the shared one: the agent lacks information.
    alone: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    # Numbers that a controller of the user shares, (k,) with k at most `MAX_DATA`, in the shape that
    # the receiver's own class has declared; without any the field does not travel.
    data: Array = msgspec.field(default_factory=lambda: _NO_NUMBERS)
    # Ticks since the last solved step, 0 if it is this one: so long ago the inputs were fresh, and
    # actuators and other agents count from there.
    stale: Count = 0
    # Targets told to some agents only, as `target` messages (`protocol.admission.targets_in_plans`), oldest first:
    # the newest that the sender follows, and those before on which its path still depends.
    targets: Carried = ()
    # Ticks by which the sender's path is behind the one that was given, with `controller.silence` stop.
    lag: Count = 0

    @property
    def solved_tick(self) -> int:
        """Tick of the last solved step."""
        return self.tick - self.stale

    def played(self, tick: int) -> int:
        """Return the number of steps played before a tick since the inputs were fresh."""
        return tick - self.start_tick + self.stale

    def check(self) -> None:
        """Check the arrays, their steps, and that inputs were fresh at some tick of the run."""
        Message.check(self)
        steps = len(self.inputs)
        if not 1 <= steps <= MAX_HORIZON:
            raise MessageError(
                "out_of_range", f"inputs: expected 1 to {MAX_HORIZON} steps, got {steps}"
            )
        if len(self.corrections) not in (0, steps):
            text = f"corrections: expected none or {steps} steps, got {len(self.corrections)}"
            raise MessageError("wrong_shape", text)
        if len(self.data) > MAX_DATA:
            text = f"data: expected at most {MAX_DATA} numbers, got {len(self.data)}"
            raise MessageError("out_of_range", text)
        if self.lag > self.tick:
            text = f"lag: expected at most the {self.tick} ticks so far, got {self.lag}"
            raise MessageError("out_of_range", text)
        if self.stale > self.tick:
            text = f"stale: expected at most the {self.tick} ticks so far, got {self.stale}"
            raise MessageError("out_of_range", text)


# For the record. The coordinator reads one of them, `PlantState`: it ends a diverged run


class StepReport(Message, tag="report", frozen=True, kw_only=True):
    """Agent to the record: one step, with the result of its solve."""

    route: ClassVar[Route] = Route(
        sender=AGENT, receivers=(RECORDER, WATCHER), each="agent", grows="tick"
    )
    shapes: ClassVar[Mapping[str, ShapeOf]] = {
        "force": lambda _: (3,),
        "times_ms": lambda _: (len(STAGES),),
    }
    as_long: ClassVar[tuple[str, ...]] = "peers", "plan_ages", "state_ages"

    agent: Agent
    status: PlanStatus
    solver: Text
    fallback: bool
    iterations: Count
    residual: Finite  # the worst KKT residual, or -1 when there is none
    peers: Ids  # the other agents, ascending
    # Age in ticks of the newest plan used of each of `peers`; -1 where none was ever received, and for
    # those that are off the roster.
    plan_ages: Ages
    state_ages: Ages  # the same for the newest state of each
    measurement_age: Age  # the same for the newest measurement used
    delivered: Count  # plans of others that became usable at this tick
    lost: Count  # plans of earlier ticks that are known from now on to be lost on their link
    late: Count  # delivered plans that were older than one tick
    force: Array  # estimated, on the payload, inertial frame, (3,), N; or zero
    # Of `STAGES` by the wall clock, not reproducible, (8,); "publish" is that of the step before.
    times_ms: Array
    measurements_lost: Count = 0  # that are known from now on to be lost on their link


class Note(Message, tag="note", frozen=True, kw_only=True):
    """Agent to the record: numbers of a controller or filter, or why a step has failed."""

    route: ClassVar[Route] = Route(sender=AGENT, receivers=(RECORDER, WATCHER), each="agent")
    shapes: ClassVar[Mapping[str, ShapeOf]] = {"values": lambda message: (len(message.names),)}

    agent: Agent
    problem: Text  # controller, method, error, file and line; empty if the step has not failed
    names: Names  # of the numbers
    values: Array  # the numbers, in the same order


class PlantState(Message, tag="plant_state", frozen=True, kw_only=True):
    """Plant to record and coordinator: the true state at tick k and the inputs until k + 1."""

    route: ClassVar[Route] = Route(
        sender=PLANT, receivers=(COORDINATOR, RECORDER, WATCHER), grows="tick"
    )
    shapes: ClassVar[Mapping[str, ShapeOf]] = {
        "x": lambda message: (PAYLOAD + PER_UAV * len(message.plan_ticks),),
        "u": lambda message: (INPUTS * len(message.plan_ticks),),
    }

    x: Array  # (12 + 12 N,), SI
    u: Array  # commands over [t_k, t_{k+1}), (4 N,), SI
    # Of the plan each UAV followed: -1 before any plan, -2 for the fail-safe, -3 with motors off.
    plan_ticks: PlanTicks
    local_error: Finite  # largest local error estimate of the integration over the interval, SI
    diverged: Text  # empty, or why the run ends after this interval
    plans_lost: Count = 0  # known from now on to be lost on their link to the plant


class ActualInputs(Message, tag="actual_inputs", frozen=True, kw_only=True):
    """Plant to the record: mean thrust and moments over [t_k, t_{k+1}), least tensions of cables.

    Sent only in a run whose motors are not ideal, with commanded body rates or with cables.
    """

    route: ClassVar[Route] = Route(sender=PLANT, receivers=(RECORDER,), grows="tick")
    shapes: ClassVar[Mapping[str, ShapeOf]] = {
        "inputs": _per_uav(INPUTS),
        "tensions": lambda one: (len(one.cables),),
    }

    uavs: Ids  # all of them, 1-based ids, ascending
    inputs: Array  # (N, 4), N and N m
    cables: Ids = ()  # UAVs on cables, in the order of `uavs`; none with rods
    # Of these, N, 0 while slack.
    tensions: Array = msgspec.field(default_factory=lambda: _NO_NUMBERS)


class FaultNote(Message, tag="fault", frozen=True, kw_only=True):
    """Fault injected into a process, or a process that ended by itself; in the log only."""

    route: ClassVar[Route] = Route(sender=RECORDER, receivers=())

    target: Text  # name of the process
    what: Text  # "killed", "stopped", CONTINUED, "restarted" or how it ended
    origin: FaultOrigin  # the scenario's script, a person, or unknown to the recorder


class Rejected(Message, tag="rejected", frozen=True, kw_only=True):
    """Any process to the record: it has refused messages.

    Not reproducible; sequence numbers count this kind alone.
    """

    route: ClassVar[Route] = Route(sender=None, receivers=(RECORDER, WATCHER), each="sender")

    offender: Text  # sender according to the messages, or the key they came under
    reason: Reason  # why they were refused
    # How many since the last message about this offender and reason.
    count: Annotated[int, Meta(ge=1, le=10_000_000)]
    example: Text  # the error of the first of all of them, for people


# Message classes by kind, in the order of their definition: codec, keys, log and exports are built
# from them.
KINDS = kinds_below(Message)


@dataclass(frozen=True, slots=True)
class Presence:
    """Event for a node, made from liveliness tokens: a process is there, or gone."""

    name: str
    incarnation: int  # which start of it
    alive: bool  # ready to take part; False when its token is gone


@dataclass(frozen=True, slots=True)
class Request:
    """Event for a node: a client asks for something and waits for the answer."""

    what: str  # such as "status" or "link"
    given: Mapping[str, Any]  # its arguments
    reply: Callable[[Mapping[str, Any]], None]  # to be called once, with the answer


Event = Message | Presence | Request
