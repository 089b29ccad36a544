"""The messages of a run: frozen, validated at construction, equal on every runtime.

Who sends what to whom, per tick: coordinator -> plant `Tick`; plant -> each agent `Measurement`; agent -> plant,
coordinator and, when it is shared, the other agents `Plan`. For the record: plant `PlantState`, agents
`StepReport`, any process `Rejected`. Around them: coordinator `Roster` and `Control`. Presence is not a message: it
comes from liveliness tokens, and nodes receive it as an event.
"""

import math
import operator
import re
import reprlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import UnionType
from typing import Any, ClassVar, Literal, get_args

import numpy as np

from model.arrays import Array, NotFiniteError, ShapeError, checked
from model.state import INPUTS, PAYLOAD, PER_UAV

# Limits of what a message may claim; beyond them it is garbage, whoever sent it.
MAX_UAVS = 256
MAX_HORIZON = 10_000
MAX_NEGOTIATION_ITERATIONS = 20
MAX_TICK = 2**48
MAX_TEXT = 1_000

# Values in error texts: a few entries of a few levels, however much there is.
_BRIEFLY = reprlib.Repr()
_BRIEFLY.maxstring = _BRIEFLY.maxother = _BRIEFLY.maxlong = 60

_FLOAT64 = np.dtype(np.float64)
_NAME = re.compile(r"coordinator|plant|recorder|agent[1-9][0-9]{0,2}")
_NAMES = frozenset(["coordinator", "plant", "recorder", *(f"agent{agent}" for agent in range(1, MAX_UAVS + 1))])

Outcome = Literal["completed", "diverged", "aborted"]
FaultOrigin = Literal["script", "person", "unknown"]
PlanStatus = Literal["solved", "infeasible", "limit", "numerical"]
_PLAN_STATUSES = get_args(PlanStatus)
# Why a message is refused: docs/protocol.md says what each means.
Reason = Literal[
    "oversized",
    "wrong_version",
    "malformed",
    "unknown_kind",
    "wrong_shape",
    "not_finite",
    "out_of_range",
    "wrong_sender",
    "unknown_agent",
    "wrong_incarnation",
    "replayed",
    "past",
    "future",
    "wrong_uavs",
    "outside_limits",
]
# Of an agent's step: waiting for the measurement, the work, publishing; the total is of the work alone.
STAGES = ("wait", "estimate", "linearise", "discretise", "condense", "solve", "publish", "total")


class MessageError(ValueError):
    """A message that is refused.

    Args:
        reason: Why, one of a few.
        text: The field, what was expected and what came.
        sender: Who sent it by its own account, where that could be read.
    """

    def __init__(self, reason: Reason, text: str, sender: str = "") -> None:
        super().__init__(text)
        self.reason, self.sender = reason, sender


def agent_name(agent: int) -> str:
    """Process name of an agent, e.g. "agent2"."""
    return f"agent{agent}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Message:
    """What every message carries.

    Attributes:
        sender: Process name: "coordinator", "plant", "agent1"...
        incarnation: Which start of that process, growing with every restart.
        sequence: Number of the message among all its sender sent in this incarnation, from 0.
        tick: The sampling instant it belongs to, from 0.
    """

    kind: ClassVar[str]

    sender: str
    incarnation: int
    sequence: int
    tick: int

    def __post_init__(self) -> None:
        _name("sender", self.sender)
        self._integers("incarnation", "sequence", "tick")

    def _set(self, field: str, value: Any) -> None:
        if value is not getattr(self, field):  # mostly it is as it should be
            object.__setattr__(self, field, value)

    def _integers(self, *fields: str, low: int = 0) -> None:
        for field in fields:
            value = getattr(self, field)
            if type(value) is not int or not low <= value <= MAX_TICK:
                self._set(field, _integer(field, value, MAX_TICK, low=low))


@dataclass(frozen=True, slots=True, kw_only=True)
class Tick(Message):
    """Coordinator to plant: tick k is open.

    Attributes:
        members: Agents whose plans of this tick the clock will wait for.
        answered: Agents whose plans of tick k - 1 count: whoever uses plans of k - 1 waits for these.
        shared: Those of them that sent the plan to the other agents as well.
        roster: Version of the roster in force: whoever has an older one waits for it.
        late_ns: In real time, how long after its deadline the tick was opened; else 0.
        overrun_ns: In real time, by how much the latest plan that came since the tick before missed its
            deadline, the opening of the tick after its own; else 0.
    """

    kind: ClassVar[str] = "tick"

    members: tuple[int, ...]
    answered: tuple[int, ...]
    shared: tuple[int, ...]
    roster: int
    late_ns: int
    overrun_ns: int

    def __post_init__(self) -> None:
        Message.__post_init__(self)
        for field in ("members", "answered", "shared"):
            self._set(field, _ids(field, getattr(self, field)))
        self._integers("roster", "late_ns", "overrun_ns")


@dataclass(frozen=True, slots=True, kw_only=True)
class Roster(Message):
    """Coordinator to everybody: who takes part from this tick on.

    Attributes:
        version: Grows with every change.
        agents: Agents on the roster.
        incarnations: Their incarnations, in the same order; messages of other incarnations are refused.
        off: UAVs whose motors give no thrust and no moments, 1-based ids, ascending; the released ones too.
        released: UAVs that are no longer on their rods, 1-based ids, ascending.
        reason: Why it changed, for people.
    """

    kind: ClassVar[str] = "roster"

    version: int
    agents: tuple[int, ...]
    incarnations: tuple[int, ...]
    off: tuple[int, ...]
    released: tuple[int, ...]
    reason: str

    def __post_init__(self) -> None:
        Message.__post_init__(self)
        self._integers("version")
        self._set("agents", _ids("agents", self.agents))
        self._set("incarnations", _integer_list("incarnations", self.incarnations))
        self._set("off", _ids("off", self.off))
        self._set("released", _ids("released", self.released))
        self._set("reason", _text("reason", self.reason))
        if not set(self.released) <= set(self.off):
            raise MessageError(
                "out_of_range", f"released: expected UAVs among those off {list(self.off)}, got {list(self.released)}"
            )
        if len(self.agents) != len(self.incarnations):
            raise MessageError(
                "wrong_shape",
                f"incarnations: expected one for each of {len(self.agents)} agents, got {len(self.incarnations)}",
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement(Message):
    """Plant to one agent: what its sensors see at tick k. It opens the tick for that agent.

    Attributes:
        agent: The agent it is for.
        answered: Forwarded from the tick: who planned at tick k - 1.
        shared: Forwarded from the tick: whose plans of tick k - 1 to wait for.
        roster: Forwarded from the tick: the version of the roster in force.
        payload: Payload states r0, v0, Theta0, omega0, (12,), SI.
        uavs: Owned UAVs, 1-based ids, ascending.
        uav_states: Their states e, Omega, Theta, omega, (owned, 12), SI.
        inputs: What their actuators did until now, (owned, 4), N and N m.
    """

    kind: ClassVar[str] = "measurement"

    agent: int
    answered: tuple[int, ...]
    shared: tuple[int, ...]
    roster: int
    payload: Array
    uavs: tuple[int, ...]
    uav_states: Array
    inputs: Array

    def __post_init__(self) -> None:
        Message.__post_init__(self)
        self._set("agent", _integer("agent", self.agent, MAX_UAVS, low=1))
        for field in ("answered", "shared"):
            self._set(field, _ids(field, getattr(self, field)))
        self._integers("roster")
        self._set("payload", _array("payload", self.payload, (PAYLOAD,)))
        self._set("uavs", _ids("uavs", self.uavs))
        self._set("uav_states", _array("uav_states", self.uav_states, (len(self.uavs), PER_UAV)))
        self._set("inputs", _array("inputs", self.inputs, (len(self.uavs), INPUTS)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan(Message):
    """Agent to plant and coordinator, and if shared to the other agents: its state now and the inputs it will apply.

    Attributes:
        agent: Who planned.
        start_tick: First sampling instant the inputs are for.
        uavs: Owned UAVs, 1-based ids, ascending.
        uav_states: Their states at `tick`, (owned, 12), SI.
        inputs: Absolute inputs per step from `start_tick`, (N_p, 4 owned), N and N m.
        corrections: Corrections to the shared law that go with them, (N_p, 4 owned); no rows without that law.
        status: How the solve went; anything but "solved" means the shifted previous plan.
        negotiation: 0 for the plan a tick ends with; otherwise how many exchanges within the tick follow.
        shared: Whether the other agents get it: it travels under another key if not.
    """

    kind: ClassVar[str] = "plan"

    agent: int
    start_tick: int
    negotiation: int
    shared: bool
    uavs: tuple[int, ...]
    uav_states: Array
    inputs: Array
    corrections: Array
    status: PlanStatus

    def __post_init__(self) -> None:
        Message.__post_init__(self)
        self._set("agent", _integer("agent", self.agent, MAX_UAVS, low=1))
        self._integers("start_tick")
        self._set("negotiation", _integer("negotiation", self.negotiation, MAX_NEGOTIATION_ITERATIONS - 1))
        self._set("shared", _boolean("shared", self.shared))
        self._set("uavs", _ids("uavs", self.uavs))
        self._set("uav_states", _array("uav_states", self.uav_states, (len(self.uavs), PER_UAV)))
        for field in ("inputs", "corrections"):
            self._set(field, _array(field, getattr(self, field), (None, INPUTS * len(self.uavs))))
        _choice("status", self.status, _PLAN_STATUSES)
        if not 1 <= len(self.inputs) <= MAX_HORIZON:
            raise MessageError("out_of_range", f"inputs: expected 1 to {MAX_HORIZON} steps, got {len(self.inputs)}")
        if len(self.corrections) not in (0, len(self.inputs)):
            raise MessageError(
                "wrong_shape",
                f"corrections: expected none or {len(self.inputs)} steps, got {len(self.corrections)}",
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class StepReport(Message):
    """Agent to the record: how one step went.

    Attributes:
        agent: Who reports.
        status, solver, fallback, iterations, residual: Of the solve; residual is the worst KKT residual,
            or -1 when there is none.
        plan_ages: Age in ticks of the newest plan used of each other agent, in the order of `peers`.
        state_ages: The same for the newest state of each.
        peers: The other agents, ascending; an age of -1 means nothing was ever received.
        measurement_age: The same for the newest measurement used.
        delivered: Plans of others that became usable at this tick.
        lost: Plans of earlier ticks that are known from now on not to come: the link lost them.
        late: How many of the delivered ones were older than one tick.
        force: Estimated external force on the payload, (3,), inertial frame, N; zero when nobody estimates it.
        times_ms: Wall-clock per stage, in the order of `STAGES`, (8,); "publish" is that of the step before.
            Not reproducible, unlike the rest.
    """

    kind: ClassVar[str] = "report"

    agent: int
    status: PlanStatus
    solver: str
    fallback: bool
    iterations: int
    residual: float
    peers: tuple[int, ...]
    plan_ages: tuple[int, ...]
    state_ages: tuple[int, ...]
    measurement_age: int
    delivered: int
    lost: int
    late: int
    force: Array
    times_ms: Array

    def __post_init__(self) -> None:
        Message.__post_init__(self)
        self._set("agent", _integer("agent", self.agent, MAX_UAVS, low=1))
        _choice("status", self.status, _PLAN_STATUSES)
        self._set("solver", _text("solver", self.solver))
        self._set("fallback", _boolean("fallback", self.fallback))
        self._integers("iterations", "delivered", "lost", "late")
        self._integers("measurement_age", low=-1)
        self._set("residual", _number("residual", self.residual))
        self._set("peers", _ids("peers", self.peers))
        for field in ("plan_ages", "state_ages"):
            ages = _integer_list(field, getattr(self, field), low=-1)
            if len(ages) != len(self.peers):
                raise MessageError(
                    "wrong_shape", f"{field}: expected one for each of {len(self.peers)} peers, got {len(ages)}"
                )
            self._set(field, ages)
        self._set("force", _array("force", self.force, (3,)))
        self._set("times_ms", _array("times_ms", self.times_ms, (len(STAGES),)))


@dataclass(frozen=True, slots=True, kw_only=True)
class PlantState(Message):
    """Plant to the record: what really happened at tick k and until k + 1.

    Attributes:
        x: State at t_k, (12 + 12 N,), SI.
        u: Inputs applied over [t_k, t_{k+1}), (4 N,), N and N m.
        plan_ticks: Tick of the plan each UAV's actuators followed, (N): -1 before any plan, -2 for the fail-safe,
            -3 with the motors off.
        local_error: Largest local error estimate of the integration over the interval, SI.
        diverged: Empty, or why the flight ends after this interval.
    """

    kind: ClassVar[str] = "plant_state"

    x: Array
    u: Array
    plan_ticks: tuple[int, ...]
    local_error: float
    diverged: str

    def __post_init__(self) -> None:
        Message.__post_init__(self)
        self._set("plan_ticks", _integer_list("plan_ticks", self.plan_ticks, low=-3))
        N = len(self.plan_ticks)
        self._set("x", _array("x", self.x, (PAYLOAD + PER_UAV * N,)))
        self._set("u", _array("u", self.u, (INPUTS * N,)))
        self._set("local_error", _number("local_error", self.local_error))
        self._set("diverged", _text("diverged", self.diverged))


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkChange(Message):
    """Coordinator to everybody: from this tick on links treat what is sent over them differently.

    Attributes:
        number: Of the change in its run, from 1: whoever joins late is told all of them again.
        source, target: Names of the ends; empty for any agent.
        settings: Keys of a link and their new values, a JSON object (docs/scenario.md, `links`).
    """

    kind: ClassVar[str] = "link"

    number: int
    source: str
    target: str
    settings: str

    def __post_init__(self) -> None:
        Message.__post_init__(self)
        self._integers("number", low=1)
        for field in ("source", "target"):
            end = getattr(self, field)
            if not isinstance(end, str) or end:
                self._set(field, _name(field, end))
        self._set("settings", _text("settings", self.settings))


@dataclass(frozen=True, slots=True, kw_only=True)
class Rejected(Message):
    """Any process to the record: it has refused messages. Sent only when there were any; not reproducible.

    Its sequence numbers count messages of this kind alone, so that they do not change those of the others.

    Attributes:
        offender: Who sent them by their own account, or the key they came under.
        reason: Why they were refused.
        count: How many since the last message about this offender and reason.
        example: What was wrong with the first of all of them, for people.
    """

    kind: ClassVar[str] = "rejected"

    offender: str
    reason: Reason
    count: int
    example: str

    def __post_init__(self) -> None:
        Message.__post_init__(self)
        for field in ("offender", "example"):
            self._set(field, _text(field, getattr(self, field)))
        _choice("reason", self.reason, get_args(Reason))
        self._integers("count", low=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Control(Message):
    """Coordinator to everybody: the run ends here.

    Attributes:
        outcome: How.
        reason: Why, for people; empty when completed.
        exit_code: What every process should exit with.
    """

    kind: ClassVar[str] = "control"

    outcome: Outcome
    reason: str
    exit_code: int

    def __post_init__(self) -> None:
        Message.__post_init__(self)
        _choice("outcome", self.outcome, get_args(Outcome))
        self._set("reason", _text("reason", self.reason))
        self._set("exit_code", _integer("exit_code", self.exit_code, 255))


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultNote(Message):
    """For the record alone: something was done, or happened, to a process.

    Attributes:
        target: The process.
        what: "killed", "stopped", "continued", "started" or how it ended.
        origin: By whom: the scenario's script, a person, or nobody the recorder knows of.
    """

    kind: ClassVar[str] = "fault"

    target: str
    what: str
    origin: FaultOrigin

    def __post_init__(self) -> None:
        Message.__post_init__(self)
        self._set("target", _name("target", self.target))
        self._set("what", _text("what", self.what))
        _choice("origin", self.origin, get_args(FaultOrigin))


KINDS: dict[str, type[Message]] = {
    cls.kind: cls
    for cls in (Tick, Roster, LinkChange, Measurement, Plan, StepReport, PlantState, FaultNote, Rejected, Control)
}


@dataclass(frozen=True, slots=True)
class Presence:
    """Event for a node, made from liveliness tokens: a process is there, or no longer.

    Attributes:
        name: Process name.
        incarnation: Which start of it.
        alive: True when it is ready to take part, False when its token is gone.
    """

    name: str
    incarnation: int
    alive: bool


@dataclass(frozen=True, slots=True)
class Request:
    """Event for a node: somebody asks for something and waits for the answer.

    Attributes:
        what: "status" or "link".
        given: Its arguments.
        reply: To be called once, with the answer.
    """

    what: str
    given: Mapping[str, Any]
    reply: Callable[[Mapping[str, Any]], None]


Event = Message | Presence | Request


def is_name(value: object) -> bool:
    """Whether something is the name of a process."""
    return isinstance(value, str) and _NAME.fullmatch(value) is not None


def _name(field: str, value: object) -> str:
    if type(value) is str and value in _NAMES:
        return value
    if not isinstance(value, str) or not _NAME.fullmatch(value):
        raise MessageError(_sort(value, str), f"{field}: expected a process name, got {_shown(value)}")
    return value


def _integer(field: str, value: object, high: int, *, low: int = 0) -> int:
    if type(value) is int and low <= value <= high:
        return value
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not low <= value <= high:
        text = f"{field}: expected an integer in [{low}, {high}], got {_shown(value)}"
        raise MessageError(_sort(value, int | np.integer), text)
    return int(value)


def _number(field: str, value: object) -> float:
    if type(value) is float and math.isfinite(value):
        return value
    if isinstance(value, bool) or not isinstance(value, int | float | np.floating) or not np.isfinite(value):
        reason: Reason = "not_finite" if isinstance(value, float | np.floating) else "wrong_shape"
        raise MessageError(reason, f"{field}: expected a finite number, got {_shown(value)}")
    return float(value)


def _boolean(field: str, value: object) -> bool:
    if not isinstance(value, bool):
        raise MessageError("wrong_shape", f"{field}: expected true or false, got {_shown(value)}")
    return value


def _text(field: str, value: object) -> str:
    # Half of a surrogate pair is text for Python but cannot be sent.
    if (
        not isinstance(value, str)
        or len(value) > MAX_TEXT
        or not (value.isascii() or all(not "\ud800" <= c <= "\udfff" for c in value))
    ):
        text = f"{field}: expected text of at most {MAX_TEXT} characters, got {_shown(value)}"
        raise MessageError(_sort(value, str), text)
    return value


def _choice(field: str, value: object, choices: tuple[str, ...]) -> None:
    if not isinstance(value, str) or value not in choices:
        raise MessageError(_sort(value, str), f"{field}: expected one of {', '.join(choices)}, got {_shown(value)}")


def _sequence(field: str, value: object) -> tuple[Any, ...] | list[Any]:
    if not isinstance(value, tuple | list) or len(value) > MAX_UAVS:
        text = f"{field}: expected a list of at most {MAX_UAVS}, got {_shown(value)}"
        raise MessageError(_sort(value, tuple | list), text)
    return value


def _integer_list(field: str, value: object, high: int = MAX_TICK, *, low: int = 0) -> tuple[int, ...]:
    if type(value) is tuple and len(value) <= MAX_UAVS:  # as it mostly is: nothing to convert
        for i in value:
            if type(i) is not int or not low <= i <= high:
                break
        else:
            return value
    return tuple([_integer(field, i, high, low=low) for i in _sequence(field, value)])


def _ids(field: str, value: object) -> tuple[int, ...]:
    if type(value) is tuple:  # as it mostly is
        last = 0
        for i in value:
            if type(i) is not int or i <= last:
                break
            last = i
        else:
            if last <= MAX_UAVS:
                return value
    ids = _integer_list(field, value, MAX_UAVS, low=1)
    if any(map(operator.ge, ids, ids[1:])):
        raise MessageError("out_of_range", f"{field}: expected ascending ids, got {list(ids)}")
    return ids


def _array(field: str, value: object, shape: tuple[int | None, ...]) -> Array:
    if not isinstance(value, np.ndarray):
        raise MessageError("wrong_shape", f"{field}: expected an array, got {_shown(value)}")
    if _is_as_decoded(value, shape) and math.isfinite(np.vdot(value, value)):
        return value
    try:
        return checked(field, value, shape)
    except NotFiniteError as error:
        raise MessageError("not_finite", str(error)) from error
    except ShapeError as error:
        raise MessageError("wrong_shape", str(error)) from error


def _is_as_decoded(value: Array, shape: tuple[int | None, ...]) -> bool:
    """Whether an array of this shape lies in the bytes it came in, which nobody can change: it needs no copy."""
    owner: object = value.base
    if not isinstance(owner, bytes) or value.dtype is not _FLOAT64:
        return False
    return len(value.shape) == len(shape) and value.shape[1:] == shape[1:] and shape[0] in (None, value.shape[0])


def _sort(value: object, expected: type | UnionType) -> Reason:
    """Why a value is refused: its type, or else its size."""
    right = isinstance(value, expected) and not isinstance(value, bool)
    return "out_of_range" if right else "wrong_shape"


def _shown(value: object) -> str:
    text = " ".join(_BRIEFLY.repr(value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."
