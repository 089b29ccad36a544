"""Comparison of the messages of a replay with the recorded ones, field by field and bit by bit."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from transport.analysis.replay.replay_of_agent import Answer, ReplayedStep
from transport.log.tables import INPUT_NAMES
from transport.model.arrays import Array
from transport.model.state import INPUTS
from transport.protocol.wire.messages import Plan

# Fields that identify a message or depend on the wall clock.
_NOT_COMPARED = ("sender", "incarnation", "sequence", "tick", "agent", "negotiation", "times_ms")


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """A field in which a message differs from the recorded one, at the entry that differs most."""

    tick: int
    kind: str  # of the message, plan or report
    negotiation: int  # iterations of negotiation that follow the plan; 0 for a report
    name: str  # of the field
    where: str  # description of the entry; empty for a scalar field
    got: str  # replayed value
    expected: str  # recorded value
    size: float | None  # absolute difference, SI; None if the field is no number

    @property
    def field(self) -> str:
        """The field with its kind of message, e.g. plan.inputs."""
        return f"{self.kind}.{self.name}"


class InputsApart(NamedTuple):
    """Largest differences of the inputs of a plan: thrust, N, and moments, N m, or rates, rad/s."""

    tick: int
    first_thrust_N: float  # at the first step
    first_turning: float
    thrust_N: float  # over the horizon
    turning: float

    @property
    def largest(self) -> float:
        """The largest of all differences, whatever the unit."""
        return max(self.thrust_N, self.turning)


@dataclass(slots=True)
class Comparison:
    """Comparison of a replay with its run."""

    ticks: list[int] = field(default_factory=list)  # compared, in order
    plans: int = 0  # number of plans compared
    identical: int = 0  # number of plans that are equal bit for bit
    # Ticks with an answer of the node that the log lacks.
    unrecorded: list[int] = field(default_factory=list)
    # Differences by field, in the order in which the fields first differ.
    by_field: dict[str, list[Difference]] = field(default_factory=dict)
    inputs_apart: list[InputsApart] = field(default_factory=list)  # of each tick compared
    command_names: tuple[str, ...] = INPUT_NAMES  # names of the inputs in plans

    @property
    def first(self) -> Difference | None:
        """The first difference in a plan; None if all plans are equal."""
        earliest = [differing[0] for differing in self.by_field.values()]
        of_plans = [difference for difference in earliest if difference.kind == Plan.kind]
        # Within a tick earlier iterations have larger numbers.
        return min(of_plans, key=lambda one: (one.tick, -one.negotiation), default=None)

    def first_beyond(self, size: float) -> int | None:
        """Return the first tick at which an input of the plan differs by more than a size.

        The size is in the unit of the input: N, N m or rad/s. None if there is no such tick.
        """
        return next((apart.tick for apart in self.inputs_apart if apart.largest > size), None)

    def add(self, step: ReplayedStep, *, ignored: Iterable[str] = ()) -> None:
        """Compare the replayed and recorded messages of one tick.

        All or nothing: a tick with an answer that the log lacks is not compared. Ignored fields, such
        as report.lost, do not count.
        """
        recorded_ones = [recorded for recorded in step.recorded if recorded is not None]
        if len(recorded_ones) < len(step.answers):
            self.unrecorded.append(step.tick)
            return

        self.ticks.append(step.tick)
        for answer, recorded in zip(step.answers, recorded_ones, strict=True):
            differing = [
                difference
                for difference in differences(answer, recorded, self.command_names)
                if difference.field not in ignored
            ]
            for difference in differing:
                self.by_field.setdefault(difference.field, []).append(difference)

            if isinstance(answer, Plan):
                self.plans += 1
                self.identical += not differing
            if isinstance(answer, Plan) and isinstance(recorded, Plan) and answer.negotiation == 0:
                self.inputs_apart.append(_inputs_apart(answer, recorded))


def differences(
    answer: Answer, recorded: Answer, command_names: tuple[str, ...] = INPUT_NAMES
) -> Iterator[Difference]:
    """Yield the fields in which two messages of one kind differ by at least a bit; 0 and -0 do."""
    for name in answer.__struct_fields__:
        if name in _NOT_COMPARED:
            continue
        got = np.asarray(getattr(answer, name))
        expected = np.asarray(getattr(recorded, name))
        if got.shape == expected.shape and got.tobytes() == expected.tobytes():
            continue
        yield _difference(answer, name, (got, expected), command_names)


def _difference(
    answer: Answer, name: str, values: tuple[Array, Array], command_names: tuple[str, ...]
) -> Difference:
    """Return how a field of a message differs, from its replayed and its recorded value.

    Of numbers in arrays of the same shape it is the entry that differs most, of others their texts or lengths.
    """
    got, expected = values
    where = ""
    size = None
    texts = [str(value) for value in values]
    if got.shape == expected.shape and got.dtype.kind in "if":
        apart = np.abs(got - expected)
        entry = np.unravel_index(int(apart.argmax()), got.shape)
        where = _entry(answer, name, [int(index) for index in entry], command_names)
        size = float(apart[entry])
        texts = [str(value[entry]) for value in values]
    elif got.ndim:
        texts = [f"{len(value)} entries" for value in values]

    return Difference(
        tick=answer.tick,
        kind=answer.kind,
        negotiation=answer.negotiation if isinstance(answer, Plan) else 0,
        name=name,
        where=where,
        got=texts[0],
        expected=texts[1],
        size=size,
    )


def _entry(message: Answer, name: str, index: list[int], command_names: tuple[str, ...]) -> str:
    """Return a description of an array entry; empty for a scalar."""
    if isinstance(message, Plan) and name in ("inputs", "corrections"):
        step, column = index
        uav = message.uavs[column // INPUTS]
        command = command_names[column % INPUTS]
        return f"{index}, UAV{uav} {command}, step {step} of the horizon"
    return str(index) if index else ""


def _inputs_apart(plan: Plan, recorded: Plan) -> InputsApart:
    """Return the largest differences of the inputs of two plans.

    Steps that only one horizon has are left out.
    """
    steps = min(len(plan.inputs), len(recorded.inputs))
    apart: Array = np.abs(plan.inputs[:steps] - recorded.inputs[:steps])
    by_uav = apart.reshape(steps, -1, INPUTS)
    thrust_N = by_uav[:, :, 0].max(axis=1)
    turning = by_uav[:, :, 1:].max(axis=(1, 2))
    return InputsApart(
        tick=plan.tick,
        first_thrust_N=float(thrust_N[0]),
        first_turning=float(turning[0]),
        thrust_N=float(thrust_N.max()),
        turning=float(turning.max()),
    )
