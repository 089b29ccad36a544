"""Checks of what a step of the user's controller returns: inputs, and numbers for the log."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from transport.agent.own_run import Run
from transport.model.arrays import Array
from transport.protocol.scenario.own_class import OwnClassError, real_array
from transport.protocol.wire.messages import MAX_NAME, MAX_NAMES


@dataclass(frozen=True, slots=True, kw_only=True)
class Returned:
    """Result of a step."""

    inputs: Array  # (rows, 4 owned), of the ticks from the first on that the plan acts at
    numbers: Mapping[str, float]  # for the log, by name
    shape: tuple[int, ...]  # of the inputs as they were returned


def converted(returned: object) -> Returned:
    """Return inputs, or inputs and a mapping, as arrays and numbers; raise if they are none."""
    inputs = returned
    numbers: Mapping[object, Any] = {}
    if isinstance(returned, tuple) and len(returned) == 2 and isinstance(returned[1], Mapping):
        inputs, numbers = returned
    array = real_array(inputs)
    return Returned(
        inputs=np.atleast_2d(array),
        numbers={str(name): float(value) for name, value in dict(numbers).items()},
        shape=array.shape,
    )


def checked(returned: Returned, run: Run) -> Returned:
    """Return the result of a step with its inputs within the limits.

    Raises: OwnClassError: with got and expected.
    """
    _check_shape(returned, run)
    _check_finite(returned)
    _check_names(returned.numbers)
    return replace(returned, inputs=np.clip(returned.inputs, run.lower, run.upper))


def _check_shape(returned: Returned, run: Run) -> None:
    inputs = returned.inputs
    columns = len(run.lower)
    is_right = inputs.ndim == 2 and inputs.shape[1] == columns
    if not is_right or not 1 <= len(inputs) <= run.horizon:
        expected = f"expected shape ({columns},) or (1 to {run.horizon}, {columns})"
        raise OwnClassError(f"step: {expected}, got {returned.shape}")


def _check_finite(returned: Returned) -> None:
    inputs = {f"input {list(place)}": u for place, u in np.ndenumerate(returned.inputs)}
    for name, value in {**inputs, **returned.numbers}.items():
        if not math.isfinite(value):
            expected = "expected finite inputs and numbers for the log"
            raise OwnClassError(f"step: {expected}, got {name} = {value}")


def _check_names(numbers: Mapping[str, float]) -> None:
    if len(numbers) > MAX_NAMES or any(len(name) > MAX_NAME for name in numbers):
        limits = f"at most {MAX_NAMES} numbers with names of at most {MAX_NAME} characters"
        raise OwnClassError(f"step: expected {limits} for the log, got {len(numbers)}")
