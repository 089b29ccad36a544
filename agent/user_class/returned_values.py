"""Checks of what a step of the user's controller returns: inputs, own data, numbers for the log."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from transport.agent.user_class.run_for_user import Run
from transport.model.arrays import Array
from transport.protocol.scenario.user_class.user_errors import OwnClassError, real_array
from transport.protocol.wire.message_form import MAX_NAME, MAX_NAMES
from transport.protocol.wire.messages import PlanStatus


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """Result of `step` or `negotiate` of a controller of the user, each part by name."""

    # (4 owned,) or (rows, 4 owned), of the ticks from the first on that the plan acts at.
    inputs: Any
    data: Any = None  # for the other agents, in the shape that `run.share` has declared
    numbers: Mapping[str, float] = field(default_factory=dict)  # for the log, by name
    send: bool = True  # whether the other agents get the plan; see `Run.must_send`


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """Result of a call as a plan has it: that of the class, or the shifted previous inputs with the reason."""

    inputs: Array  # (rows, 4 owned), of the ticks from the first on that the plan acts at
    asked: Array | None = None  # as the class returned them, before limits; None if it did not
    data: Array = field(default_factory=lambda: np.zeros(0))  # for the others, flat; none without
    numbers: Mapping[str, float] = field(default_factory=dict)  # for the log, by name
    status: PlanStatus = "solved"
    send: bool = True  # whether the others get the plan
    problem: str = ""  # why the step failed; empty if it did not
    unchanged: int = 0  # ticks for which the inputs have been the same, if that is suspicious


def converted(returned: object, method: str, data_shape: tuple[int, ...] | None) -> Outcome:
    """Return the result of a method as arrays and numbers.

    Raises: OwnClassError: the data are not those that the class has declared.
    Raises: TypeError, ValueError: a part is no array of real numbers.
    """
    step = returned if isinstance(returned, Step) else _parts(returned, data_shape)
    inputs = real_array(step.inputs)
    return Outcome(
        inputs=np.atleast_2d(inputs),
        asked=inputs,
        data=_data(step.data, method, data_shape),
        numbers={
            str.__str__(str(name)): float(value) for name, value in dict(step.numbers).items()
        },
        send=bool(step.send),
    )


def _parts(returned: object, data_shape: tuple[int, ...] | None) -> Step:
    """Return inputs, (inputs, numbers), (inputs, data) or (inputs, data, numbers) by name.

    Numbers are told by their type. Without declared data a tuple without numbers is rows of inputs.
    """
    if not isinstance(returned, tuple):
        return Step(inputs=returned)
    parts = list(returned)
    numbers: Mapping[str, float] = {}
    if len(parts) > 1 and isinstance(parts[-1], Mapping):
        numbers = parts.pop()
    if len(parts) == 1:
        return Step(inputs=parts[0], numbers=numbers)
    if len(parts) == 2 and (data_shape is not None or len(returned) == 3):
        return Step(inputs=parts[0], data=parts[1], numbers=numbers)
    return Step(inputs=tuple(parts), numbers=numbers)


def _data(given: object, method: str, shape: tuple[int, ...] | None) -> Array:
    """Return own data, flat. Raises: OwnClassError: not of the declared shape."""
    if shape is None:
        if given is not None:
            got = "data, which no run.share(shape) in start has declared"
            raise OwnClassError(f"{method}: expected inputs and numbers for the log, got {got}")
        return np.zeros(0)
    expected = f"expected data of shape {shape}, as declared by run.share"
    if given is None:
        raise OwnClassError(f"{method}: {expected}, got none")
    data = real_array(given)
    if data.shape != shape:
        raise OwnClassError(f"{method}: {expected}, got {data.shape}")
    return data.reshape(-1)


def checked(outcome: Outcome, method: str, run: Run) -> Outcome:
    """Return the result of a method with its inputs within the limits.

    Raises: OwnClassError: with got and expected.
    """
    _check_shape(outcome, method, run)
    _check_names(outcome.numbers, method)
    _check_finite(outcome, method)
    return replace(outcome, inputs=np.clip(outcome.inputs, run.lower, run.upper))


def _check_shape(outcome: Outcome, method: str, run: Run) -> None:
    inputs = outcome.inputs
    columns = len(run.lower)
    is_right = inputs.ndim == 2 and inputs.shape[1] == columns
    if not is_right or not 1 <= len(inputs) <= run.horizon:
        expected = f"expected shape ({columns},) or (1 to {run.horizon}, {columns})"
        got = () if outcome.asked is None else outcome.asked.shape
        raise OwnClassError(f"{method}: {expected}, got {got}")


def _check_finite(outcome: Outcome, method: str) -> None:
    inputs = {f"input {list(place)}": u for place, u in np.ndenumerate(outcome.inputs)}
    data = {f"data {place}, counted row by row": d for place, d in enumerate(outcome.data)}
    for name, value in {**inputs, **data, **outcome.numbers}.items():
        if not math.isfinite(value):
            expected = "expected finite inputs, data and numbers for the log"
            raise OwnClassError(f"{method}: {expected}, got {name} = {value}")


def _check_names(numbers: Mapping[str, float], method: str) -> None:
    if len(numbers) > MAX_NAMES or any(len(name) > MAX_NAME for name in numbers):
        limits = f"at most {MAX_NAMES} numbers with names of at most {MAX_NAME} characters"
        raise OwnClassError(f"{method}: expected {limits} for the log, got {len(numbers)}")
    unprintable = [name for name in numbers if not name.isprintable()]
    if unprintable:
        expected = "expected names of printable characters for the log"
        raise OwnClassError(f"{method}: {expected}, got {unprintable[0]!a}")
