"""Comparison of replayed with recorded messages: the first difference, the largest, and how many there are."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from model.arrays import Array
from model.state import INPUTS
from protocol.wire.messages import Plan, StepReport
from transport.analysis.replay import Answer, Step
from transport.log.tables import INPUT_NAMES, UAV_STATE_NAMES, split_unit

# Fields that identify a message or depend on the wall clock.
_NOT_COMPARED = ("sender", "incarnation", "sequence", "tick", "agent", "negotiation", "times_ms")


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """A field in which a message differs from the recorded one, at the entry that differs most.

    Attributes:
        tick: Tick of the message.
        kind: Kind of the message, plan or report.
        negotiation: Iterations of negotiation that follow the plan; 0 for a report.
        name: The field.
        where: Description of the entry; empty for a scalar field.
        got: Replayed value.
        expected: Recorded value.
        size: Absolute difference in the field's unit; None if the field is no number.
        unit: SI unit, empty for none.
    """

    tick: int
    kind: str
    negotiation: int
    name: str
    where: str
    got: str
    expected: str
    size: float | None
    unit: str

    @property
    def field(self) -> str:
        """The field with its kind of message, e.g. plan.inputs."""
        return f"{self.kind}.{self.name}"


@dataclass(slots=True)
class Tally:
    """The first and the largest difference of one field over a run, and the number of ticks with one."""

    first: Difference
    largest: Difference
    ticks: int = 0


@dataclass(slots=True)
class Comparison:
    """Comparison of a replay with its run.

    Attributes:
        ticks: Ticks compared, in order.
        plans: Number of plans compared.
        identical: Number of plans that are equal bit for bit.
        unrecorded: Ticks with an answer of the node but not in the log.
        tallies: By field, in the order they first differ.
        rows: For each tick compared: tick, largest difference of thrust (N) and moment (N m) of the plan's first step
            and of all its steps, and whether any field of the plan differs.
    """

    ticks: list[int] = field(default_factory=list)
    plans: int = 0
    identical: int = 0
    unrecorded: list[int] = field(default_factory=list)
    tallies: dict[str, Tally] = field(default_factory=dict)
    rows: list[tuple[int, float, float, float, float, bool]] = field(default_factory=list)

    @property
    def first(self) -> Difference | None:
        """The first difference in a plan; None if all plans are equal."""
        plans = [tally.first for tally in self.tallies.values() if tally.first.kind == Plan.kind]
        return min(plans, key=lambda d: (d.tick, -d.negotiation), default=None)

    def first_beyond(self, size: float) -> int | None:
        """Return the first tick at which an input of the plan differs by more than `size`, N or N m; None for none."""
        return next((tick for tick, *apart, _ in self.rows if max(apart) > size), None)

    def add(self, step: Step, *, ignored: Iterable[str] = ()) -> None:
        """Compare the replayed and recorded messages of one tick, except for ignored fields, e.g. report.lost."""
        if None in step.recorded:
            self.unrecorded.append(step.tick)
            return
        self.ticks.append(step.tick)
        seen: set[str] = set()
        for answer, recorded in zip(step.answers, step.recorded, strict=True):
            if recorded is None:
                continue
            found = [d for d in differences(answer, recorded) if d.field not in ignored]
            if isinstance(answer, Plan):
                self.plans += 1
                self.identical += not found
            for difference in found:
                tally = self.tallies.setdefault(difference.field, Tally(difference, difference))
                tally.largest = max(tally.largest, difference, key=lambda d: d.size or 0.0)
                tally.ticks += difference.field not in seen
                seen.add(difference.field)
            if isinstance(answer, Plan) and isinstance(recorded, Plan) and answer.negotiation == 0:
                self.rows.append((step.tick, *_inputs_apart(answer, recorded), bool(found)))


def differences(answer: Answer, recorded: Answer) -> Iterator[Difference]:
    """Yield the fields in which two messages of one kind differ by at least a bit."""
    for name in (name for name in answer.__struct_fields__ if name not in _NOT_COMPARED):
        got, expected = getattr(answer, name), getattr(recorded, name)
        if _same(got, expected):
            continue
        where, unit, size, texts = "", "", None, (_text(got), _text(expected))
        if isinstance(got, np.ndarray) and got.shape == expected.shape:
            at = _worst(got, expected)
            where, unit = _entry(answer, name, at)
            size = float(abs(got[at] - expected[at]))
            texts = repr(float(got[at])), repr(float(expected[at]))
        elif isinstance(got, int | float) and not isinstance(got, bool):
            size = float(abs(got - expected))
        elif isinstance(got, tuple) and len(got) == len(expected):
            size = float(np.abs(np.subtract(got, expected)).max())
        elif isinstance(got, np.ndarray):
            texts = f"{got.shape[0]} rows", f"{expected.shape[0]} rows"
        yield Difference(
            tick=answer.tick,
            kind=answer.kind,
            negotiation=answer.negotiation if isinstance(answer, Plan) else 0,
            name=name,
            where=where,
            got=texts[0],
            expected=texts[1],
            size=size,
            unit=unit,
        )


def _same(got: Any, expected: Any) -> bool:
    """Return whether two values have the same bits; 0 and -0 differ."""
    if isinstance(got, np.ndarray):
        return bool(got.shape == expected.shape and got.tobytes() == expected.tobytes())
    if isinstance(got, float):
        return repr(got) == repr(expected)
    return bool(got == expected)


def _worst(got: Array, expected: Array) -> tuple[int, ...]:
    """Return the index of the largest difference, or of the first 0 against -0 if there is no other."""
    apart = np.abs(got - expected)
    if not apart.any():
        apart = (np.signbit(got) != np.signbit(expected)).astype(np.float64)
    return tuple(int(i) for i in np.unravel_index(int(apart.argmax()), got.shape))


def _entry(message: Answer, name: str, at: tuple[int, ...]) -> tuple[str, str]:
    """Return a description of an array entry and its unit."""
    if isinstance(message, Plan) and name in ("inputs", "corrections"):
        quantity, unit = split_unit(INPUT_NAMES[at[1] % INPUTS])
        uav = message.uavs[at[1] // INPUTS]
        return f"[{at[0]}, {at[1]}], UAV{uav} {quantity}, step {at[0]} of the horizon", unit
    if isinstance(message, Plan):
        quantity, unit = split_unit(UAV_STATE_NAMES[at[1]])
        return f"[{at[0]}, {at[1]}], UAV{message.uavs[at[0]]} {quantity}", unit
    return f"[{', '.join(map(str, at))}]", "N" if isinstance(message, StepReport) and name == "force" else ""


def _inputs_apart(plan: Plan, recorded: Plan) -> tuple[float, float, float, float]:
    """Return the largest difference of thrust and moments, N and N m: at the first step, then over the horizon."""
    steps = min(len(plan.inputs), len(recorded.inputs))
    apart = np.abs(plan.inputs[:steps] - recorded.inputs[:steps]).reshape(steps, -1, INPUTS)
    thrust, moments = apart[:, :, 0].max(axis=1), apart[:, :, 1:].max(axis=(1, 2))
    return float(thrust[0]), float(moments[0]), float(thrust.max()), float(moments.max())


def _text(value: Any) -> str:
    return repr(value) if isinstance(value, float) else str(value)
