"""The numerical model of one system: derivative, outputs, exact linearisation, integration."""

import ctypes
import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
import numpy.typing as npt

from transport.model import native
from transport.model.arrays import Array, frozen
from transport.model.compiled import Compiled, functions, library
from transport.model.hover import with_released
from transport.model.parameters import System
from transport.model.state import input_indices

SHORTEST = 2.0**-12  # step, relative to the equal steps: 2.4 us of 10 ms
MOST_STEPS = 20_000  # tried in one integration: about a second
NAMES = (
    "X",
    "U",
    "P",
    "V_x",
    "V_u",
    "C",
)  # of the factors of a linearisation, in the order of their entries


@dataclass(frozen=True, kw_only=True, eq=False)
class Pattern:
    """Places of the entries of the sparse factors A_c = X + P V_x, B_c = U + P V_u, and of C, row by row."""

    shapes: tuple[tuple[int, int], ...]  # of the factors, in the order of `NAMES`
    begin: npt.NDArray[
        np.intp
    ]  # first entry of each row, and the end of the last, (rows of all + 1,)
    index: npt.NDArray[np.intp]  # column of each entry

    @staticmethod
    def of(factors: Sequence[Array]) -> "Pattern":
        """Return the pattern of the entries of factors that are not zero."""
        begin = np.cumsum(
            [0, *np.concatenate([np.count_nonzero(factor, axis=1) for factor in factors])],
            dtype=np.intp,
        )
        index = np.concatenate([np.nonzero(factor)[1] for factor in factors])
        frozen(begin, index)
        return Pattern(
            shapes=tuple((len(factor), factor.shape[1]) for factor in factors),
            begin=begin,
            index=index,
        )

    @cached_property
    def first_rows(self) -> list[int]:
        """First row of each factor, counted through all."""
        return np.cumsum([0, *(rows for rows, _ in self.shapes)]).tolist()  # type: ignore[no-any-return]

    @cached_property
    def addresses(self) -> tuple[int, int]:
        """Addresses of `begin` and `index`, for the compiled kernels."""
        return native.at(self.begin), native.at(self.index)

    def dense(self, values: Array, name: str) -> Array:
        """Return a factor, with entries from those of all, as a matrix."""
        which = NAMES.index(name)
        begin = self.begin[self.first_rows[which] : self.first_rows[which + 1] + 1]
        found, entries = np.zeros(self.shapes[which]), slice(begin[0], begin[-1])
        found[np.repeat(np.arange(len(found)), np.diff(begin)), self.index[entries]] = values[
            entries
        ]
        return found

    def numbered(self, name: str) -> Array:
        """Return a factor with the numbers of its entries among those of all, from 1, as a matrix."""
        return self.dense(np.arange(1.0, len(self.index) + 1.0), name)


@dataclass(frozen=True, kw_only=True)
class Linearisation:
    """The first-order expansion about (x0, u0), any.

    A_c and B_c are kept as factors: equations.md (15), (15b).
    """

    f: Array  # x' at (x0, u0), (n,), SI
    y: Array  # h(x0), (p,)
    pattern: Pattern  # places and values of the entries of the factors and of C
    values: Array

    @staticmethod
    def of(f: Array, A_c: Array, B_c: Array, y: Array, C: Array) -> "Linearisation":
        """Return an expansion whose factors are not known: X = A_c, U = B_c, no P and V."""
        n, m = B_c.shape
        factors = [A_c, B_c, np.zeros((n, 0)), np.zeros((0, n)), np.zeros((0, m)), C]
        pattern = Pattern.of([np.ones_like(factor) for factor in factors])
        return Linearisation(
            f=f, y=y, pattern=pattern, values=np.concatenate([each.reshape(-1) for each in factors])
        )

    @cached_property
    def A_c(self) -> Array:
        """df/dx along the manifold |e_i| = 1, e_i . Omega_i = 0, zero across it, (n, n), 1/s."""
        X, P, V_x = (self.pattern.dense(self.values, name) for name in ("X", "P", "V_x"))
        return X + P @ V_x

    @cached_property
    def B_c(self) -> Array:
        """df/du, (n, m)."""
        U, P, V_u = (self.pattern.dense(self.values, name) for name in ("U", "P", "V_u"))
        return U + P @ V_u

    @cached_property
    def C(self) -> Array:
        """dh/dx, (p, n)."""
        return self.pattern.dense(self.values, "C")


class Model:
    """The equations of motion of one system, evaluated numerically, with UAVs off and released, 0-based.

    External forces are (F_0, F_1, .., F_N) on the centres of mass of payload and UAVs, (3 + 3 N,),
    inertial frame, N; the payload's mass beyond the known one, kg, may follow. Inputs of UAVs off
    and forces on released ones do nothing.
    """

    def __init__(
        self, system: System, off: Collection[int] = (), released: Collection[int] = ()
    ) -> None:
        self.system, self.released = with_released(system, released), frozenset(released)
        self._off = input_indices(sorted(off))
        self._unforced = np.array(
            [3 + 3 * uav + axis for uav in sorted(released) for axis in range(3)], dtype=np.intp
        )
        self._p = self.system.vector()
        found = functions(system.N, system.commands_rates)
        self._compiled = {name: Compiled(function) for name, function in found.items()}
        self._outputs_of = found["outputs"]
        self._several_outputs: dict[int, Compiled] = {}
        held = found["sense"].sparsity_out(1)
        self._sensed = np.array(held.row()), np.array(held.get_triplet()[1])
        places = [
            found["linearise"].sparsity_out(2 + i) for i in range(len(NAMES))
        ]  # of transposed factors
        self._pattern = Pattern.of([ca.DM(factor, 1).full().T for factor in places])
        without_effect = np.hstack(
            [self._pattern.numbered(name)[:, self._off].reshape(-1) for name in ("U", "V_u")]
        )
        self._without_effect = without_effect[without_effect > 0.0].astype(np.intp) - 1
        self._no_forces = np.zeros(3 + 3 * system.N)

    def _acting(self, forces: Array | None) -> tuple[Array, Array]:
        """Return the parameters, and external forces without those on released UAVs, (3 + 3 N,)."""
        if forces is None:
            return self._p, self._no_forces
        p, count = self._p, len(self._no_forces)
        if len(forces) > count:
            p = p.copy()
            p[2:8] *= 1.0 + forces[count] / p[1]
            p[1] += forces[count]
        return p, _zeroed(forces[:count], self._unforced)

    def _arguments(self, x: Array, u: Array, forces: Array | None) -> tuple[Array, ...]:
        """Return x, u, p, F of the compiled functions; inputs of motor-off UAVs are zero."""
        return x, _zeroed(u, self._off), *self._acting(forces)

    def at_rest(self, forces: Array) -> Array:
        """Return constant forces, (3 + 3 N,), that act on a hovering team as the given ones and a mass."""
        count = len(self._no_forces)
        if len(forces) == count:
            return forces
        found = forces[:count].copy()
        found[2] += self.system.gravity * forces[count]
        return found

    def derivative(self, x: Array, u: Array, *, forces: Array | None = None) -> Array:
        """Return x' = f(x, u, F), (n,), SI. Source: docs/equations.md (4)-(13), (37)."""
        return self._compiled["derivative"](*self._arguments(x, u, forces))[0]

    def tensions(self, x: Array, u: Array, *, forces: Array | None = None) -> Array:
        """Return the rod tensions, (N,), N.

        Positive when the rod pulls. Source: docs/equations.md (9), (37).
        """
        return self._compiled["tensions"](*self._arguments(x, u, forces))[0]

    def outputs(self, x: Array) -> Array:
        """Return y = h(x), (4 N + 9,), SI. Source: docs/equations.md (14)."""
        return self._compiled["outputs"](x, self._p)[0]

    def outputs_along(self, X: Array) -> Array:
        """Return the outputs of several states, (k, n), in one call, (k, 4 N + 9), with the same bits."""
        if len(X) not in self._several_outputs:
            x, p = (
                ca.MX.sym("argument", self._outputs_of.size1_in(i), count)
                for i, count in ((0, len(X)), (1, 1))
            )
            y = self._outputs_of.map(len(X))(x, ca.repmat(p, 1, len(X)))
            self._several_outputs[len(X)] = Compiled(ca.Function("outputs", [x, p], [y]))
        return self._several_outputs[len(X)].flat(X.reshape(-1), self._p).reshape(len(X), -1)

    def velocities(self, x: Array) -> Array:
        """Return the velocities of the centres of mass, (1 + N, 3), inertial frame, m/s.

        Source: equations.md (39).
        """
        return self._compiled["velocities"](x, self._p)[0]

    def sense(self, x: Array, u: Array, *, forces: Array | None = None) -> tuple[Array, Array]:
        """Return the sensors' measurements, (15 N,), SI, and their derivatives by (x, F), (15 N, n + 3 + 3 N): (61)."""
        y, values, by_acceleration, acceleration = self._compiled["sense"](
            *self._arguments(x, u, forces)
        )
        slopes: Array = by_acceleration @ acceleration
        slopes[self._sensed] += values
        return y, slopes

    def sensed(self, x: Array, u: Array, *, forces: Array | None = None) -> Array:
        """Return the measurements of `sense` alone, (15 N,)."""
        return self._compiled["sensed"].flat(*self._arguments(x, u, forces))

    def linearise(self, x: Array, u: Array, *, forces: Array | None = None) -> Linearisation:
        """Return exact derivatives about (x, u) under constant forces.

        Equations.md (15), (15a), (37); paper (13).
        """
        function = self._compiled["linearise"]
        flat, (f, y, first) = function.flat(*self._arguments(x, u, forces)), function.parts[:3]
        values = flat[first.start :]
        values[self._without_effect] = 0.0
        return Linearisation(f=flat[f], y=flat[y], pattern=self._pattern, values=values)

    def force_effect(self, x: Array, u: Array) -> Array:
        """Return df/dF, (n, 3 + 3 N), SI per N, exact, as f is affine in the forces.

        Source: equations.md (38).
        """
        f = self.derivative(x, u)
        return np.column_stack(
            [self.derivative(x, u, forces=unit) - f for unit in np.eye(len(self._no_forces))]
        )

    def integrate(
        self, x: Array, u: Array, duration_s: float, steps: int, *, forces: Array | None = None,
        tolerance: float = math.inf,
    ) -> tuple[Array, float]:  # fmt: skip
        """Return the state after `duration_s` of constant input, (n,), and the largest local error estimate, SI.

        Dormand-Prince steps of order 5, >= 1, are equal, or halved where their estimate exceeds the
        tolerance; the rods
        are projected back after each. Source: docs/equations.md (13b), (13c).
        """
        x, *held = self._arguments(x, u, forces)
        equal_s, is_limited, largest, tried = duration_s / steps, tolerance < math.inf, 0.0, 0
        ahead_s = [equal_s] * steps  # still to take, the next one last
        while ahead_s:
            h = ahead_s.pop()
            flat, tried = self._compiled["step"].flat(x, *held, h), tried + 1
            error = float(np.abs(flat[len(x) :]).max())
            if (
                is_limited
                and not error <= tolerance
                and tried < MOST_STEPS
                and h > SHORTEST * equal_s
            ):
                ahead_s += [h / 2.0, h / 2.0]
                continue
            x, largest = flat[: len(x)], error if math.isnan(error) else max(largest, error)
            if is_limited and not np.isfinite(x).all():
                break
        return x, largest

    def stepper(
        self, duration_s: float, forces: Array | None = None
    ) -> Callable[[Array, Array], Array]:
        """Return the map from state and input to the state after one step of `integrate`, without its error."""
        held, step = self._acting(forces), self._compiled["step"]
        return lambda x, u: step.flat(x, _zeroed(u, self._off), *held, duration_s)[: len(x)]

    def rollout(
        self,
        x: Array,
        at_x: Array,
        K: Array,
        bounds: tuple[Array, Array],
        duration_s: float,
        forces: Array | None,
    ) -> tuple[Array, Array] | None:
        """Return states and inputs under u = at_x + K (x(k) - x) within bounds, in one call.

        None if not compiled.
        """
        if self._kernel is None or len(self._off):
            return None
        Z, U, acting = np.empty((len(at_x) + 1, len(x))), np.empty(at_x.shape), self._acting(forces)
        held_s, rooms, addresses = self._kernel
        Z[0], held_s[0], rooms[0][2:4] = x, duration_s, list(map(native.at, acting))
        native.KERNELS.rollout(
            len(U), len(x), len(K), *addresses, *map(native.at, (K, at_x, *bounds, Z, U))
        )
        return Z, U

    @cached_property
    def _kernel(self) -> tuple[Array, list[npt.NDArray[np.intp]], list[int | None]] | None:
        """The compiled step for the kernels.

        Its duration, s, rooms for its arguments, and the addresses of all.
        """
        path = library(self.system.N, self.system.commands_rates) if native.AVAILABLE else None
        found = None if path is None else ctypes.CDLL(str(path))
        if found is None or not hasattr(found, "step"):
            return None
        sizes, duration_s = (ctypes.c_longlong * 4)(), np.zeros(1)
        found.step_work(*(ctypes.byref(sizes, 8 * i) for i in range(4)))
        rooms = [np.zeros(size + 8, dtype=np.intp) for size in sizes]
        rooms[0][4] = native.at(duration_s)
        return (
            duration_s,
            rooms,
            [ctypes.cast(found.step, ctypes.c_void_p).value, *map(native.at, rooms)],
        )


def _zeroed(vector: Array, entries: npt.NDArray[np.intp]) -> Array:
    """Return the vector with some entries zero; a copy only if there are any."""
    if len(entries):
        vector = vector.copy()
        vector[entries] = 0.0
    return vector
