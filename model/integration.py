"""Integration over an interval of constant input: equal steps in one call, halved ones where not accurate."""

import math
from collections.abc import Sequence

import casadi as ca
import numpy as np

from model.arrays import Array
from model.compiled import Compiled

SHORTEST = 2.0**-12  # step, relative to the equal steps: 2.4 us of 10 ms
MOST_STEPS = 20_000  # tried in one integration: about a second
_BLOCK = 64  # equal steps in one call, so that memory does not grow with their number
Held = Sequence[Array]  # inputs, parameters, forces


class Integrator:
    """Integrator of one model by its compiled `step` (`model.compiled`)."""

    def __init__(self, step: ca.Function) -> None:
        self._step, self._single = step, Compiled(step)
        self._blocks: dict[int, Compiled] = {}

    def integrate(self, x: Array, held: Held, duration_s: float, steps: int, tolerance: float) -> tuple[Array, float]:
        """Return the state at the end of an interval, and the largest local error estimate of the steps taken.

        Arguments as in `Model.integrate`. Source: docs/equations.md (13b), (13c).
        """
        length_s, end, largest = duration_s / steps, x, 0.0
        for begin in range(0, steps, _BLOCK):
            count = min(_BLOCK, steps - begin)
            if count not in self._blocks:
                x_s, *held_s = (ca.MX.sym(f"argument{i}", self._step.size1_in(i)) for i in range(self._step.n_in()))
                states, errors = self._step.mapaccum(count)(x_s, *[ca.repmat(each, 1, count) for each in held_s])
                results = [states[:, -1], ca.mmax(ca.fabs(errors))]  # the last state, the largest error
                self._blocks[count] = Compiled(ca.Function("integrate", [x_s, *held_s], results))
            flat = self._blocks[count].flat(end, *held, length_s)
            end, error = flat[:-1], float(flat[-1])
            if not error <= tolerance and tolerance < math.inf:
                return self._halved(steps, x, held, length_s, tolerance)
            largest = max(largest, error)
        return end, largest

    def _halved(self, steps: int, x: Array, held: Held, length_s: float, tolerance: float) -> tuple[Array, float]:
        """Return the state after steps, each halved until its local error estimate is within the tolerance."""
        ahead_s, largest, tried = [length_s] * steps, 0.0, 0  # steps still to take, the next one last
        while ahead_s:
            h = ahead_s.pop()
            end, estimate = self._single(x, *held, h)
            error = float(np.abs(estimate).max())
            tried += 1
            if not error <= tolerance and tried < MOST_STEPS and h > SHORTEST * length_s:
                ahead_s += [h / 2.0, h / 2.0]
                continue
            x, largest = end, error if math.isnan(error) else max(largest, error)
            if not np.isfinite(x).all():
                break
        return x, largest
