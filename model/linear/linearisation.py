"""The numerical model of one system: derivative, outputs, exact linearisation, integration."""

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from transport.model.arrays import Array, frozen
from transport.model.kernels import native
from transport.model.kernels.casadi_functions import Compiled, functions
from transport.model.kernels.compiled_step import CompiledStep, Feedback
from transport.model.kernels.sparse_pattern import NAMES, Pattern
from transport.model.physics import integration
from transport.model.physics.hover import with_released
from transport.model.physics.integration import Step, StepLimits
from transport.model.physics.parameters import PAYLOAD_INERTIA, PAYLOAD_MASS, System
from transport.model.state import input_indices


@dataclass(frozen=True, kw_only=True, eq=False)
class Jacobians:
    """Derivatives of a linearisation as factors, most of whose entries are zero.

    A_c = X + P V_x,   B_c = U + P V_u
    Source: docs/equations.md (15), (15b).
    """

    pattern: Pattern  # places of the entries of the factors and of C
    values: Array  # the entries

    @cached_property
    def A_c(self) -> Array:
        """df/dx along the manifold |e_i| = 1, e_i . Omega_i = 0, zero across it, (n, n), 1/s."""
        A_c: Array = self._factor("X") + self._factor("P") @ self._factor("V_x")
        frozen(A_c)
        return A_c

    @cached_property
    def B_c(self) -> Array:
        """df/du, (n, m)."""
        B_c: Array = self._factor("U") + self._factor("P") @ self._factor("V_u")
        frozen(B_c)
        return B_c

    @cached_property
    def C(self) -> Array:
        """dh/dx, (p, n)."""
        C = self._factor("C")
        frozen(C)
        return C

    @cached_property
    def address(self) -> int:
        """Address of the entries, for the compiled kernels."""
        return native.address(self.values)

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields for copies, which have addresses of their own."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def _factor(self, name: str) -> Array:
        return self.pattern.dense(self.values, name)


@dataclass(frozen=True, kw_only=True, eq=False)
class Linearisation:
    """The first-order expansion about any pair (x0, u0). Source: docs/equations.md (15)."""

    f: Array  # x' at (x0, u0), (n,), SI
    y: Array  # h(x0), (p,)
    jacobians: Jacobians

    @staticmethod
    def of(f: Array, A_c: Array, B_c: Array, y: Array, C: Array) -> "Linearisation":
        """Return an expansion whose factors are not known: X = A_c, U = B_c, no P and V."""
        n, m = B_c.shape
        P = np.zeros((n, 0))
        V_x = np.zeros((0, n))
        V_u = np.zeros((0, m))

        factors = [A_c, B_c, P, V_x, V_u, C]
        pattern = Pattern.of([np.ones_like(factor) for factor in factors])
        values = np.concatenate([factor.reshape(-1) for factor in factors])
        return Linearisation(f=f, y=y, jacobians=Jacobians(pattern=pattern, values=values))

    @property
    def A_c(self) -> Array:
        """df/dx, (n, n), as of `Jacobians`."""
        return self.jacobians.A_c

    @property
    def B_c(self) -> Array:
        """df/du, (n, m)."""
        return self.jacobians.B_c

    @property
    def C(self) -> Array:
        """dh/dx, (p, n)."""
        return self.jacobians.C


class Model:
    """The equations of motion of one system, evaluated numerically.

    UAVs off have no motors, released ones no rod; their numbers are 0-based.

    External forces are (F_0, F_1, .., F_N) on the centres of mass of payload and UAVs, (3 + 3 N,),
    inertial frame, N. May follow: the payload's mass beyond the known one, kg, and then, where the
    system has drag, coefficients beyond the known ones of the payload and of each UAV, kg/s. Inputs
    of UAVs off and forces on released ones do nothing.
    """

    def __init__(
        self, system: System, off: Collection[int] = (), released: Collection[int] = ()
    ) -> None:
        self.system = with_released(system, released)
        self.released = frozenset(released)
        self._off = input_indices(sorted(off))

        # Places of external forces without effect, those on released UAVs.
        unforced = [3 + 3 * uav + axis for uav in sorted(released) for axis in range(3)]
        self._unforced = np.array(unforced, dtype=np.intp)
        self._no_forces = np.zeros(3 + 3 * system.N)
        self._p = self.system.vector()

        # Places of the drag of payload and UAVs in the parameters, without released ones.
        drag_places = np.arange(len(self._p) - 1 - 2 * system.N, len(self._p))
        self._payload_drag = drag_places[0]
        flying = [uav for uav in range(system.N) if uav not in released]
        self._uav_drag = drag_places[1:].reshape(-1, 2)[flying].reshape(-1)

        built = functions(*system.kind)
        self._compiled = {name: Compiled(function) for name, function in built.items()}
        self._built = built
        self._outputs_by_count: dict[int, Compiled] = {}  # of that many states in one call
        self._derivatives_by_count: dict[int, Compiled] = {}  # under that many forces

        # Places of the derivatives of measurements with the payload's acceleration held.
        held = built["sense"].sparsity_out(1)
        self._held_rows = np.array(held.row())
        self._held_columns = np.array(held.get_triplet()[1])

        # The functions return f, y and the transposed factors: CasADi stores by column.
        transposed = [built["linearise"].sparsity_out(2 + i) for i in range(len(NAMES))]
        self._pattern = Pattern.of([ca.DM(factor, 1).full().T for factor in transposed])
        self._without_effect = self._entries_of_inputs_off()

    def _entries_of_inputs_off(self) -> npt.NDArray[np.intp]:
        """Return the entries of U and V_u in the columns of motor-off UAVs."""
        columns = [self._pattern.numbered(name)[:, self._off] for name in ("U", "V_u")]
        # Entries are numbered from 1; 0 is none.
        numbers = np.hstack([column.reshape(-1) for column in columns])
        return numbers[numbers > 0.0].astype(np.intp) - 1

    def _acting(self, forces: Array | None) -> tuple[Array, Array]:
        """Return the parameters, and external forces without those on released UAVs, (3 + 3 N,).

        Further mass of the payload, behind the forces, scales its inertia too. Further drag of a UAV
        is the same in all directions.
        """
        if forces is None:
            return self._p, self._no_forces

        p = self._p
        count = len(self._no_forces)
        if len(forces) > count:
            further_kg = forces[count]
            p = p.copy()
            p[PAYLOAD_INERTIA] *= 1.0 + further_kg / p[PAYLOAD_MASS]
            p[PAYLOAD_MASS] += further_kg
            if len(forces) > count + 1:
                p[self._payload_drag] += forces[count + 1]
                p[self._uav_drag] += forces[count + 2]
        return p, _zeroed(forces[:count], self._unforced)

    def _arguments(self, x: Array, u: Array, forces: Array | None) -> tuple[Array, ...]:
        """Return x, u, p, F of the compiled functions; inputs of motor-off UAVs are zero."""
        return x, _zeroed(u, self._off), *self._acting(forces)

    def with_weight_of_mass_error(self, forces: Array) -> Array:
        """Return constant forces, (3 + 3 N,), with the weight of a further mass of the payload.

        They act on a hovering team as the given forces and that mass.
        """
        count = len(self._no_forces)
        if len(forces) == count:
            return forces

        with_weight = forces[:count].copy()
        with_weight[2] += self.system.gravity * forces[count]
        return with_weight

    def derivative(self, x: Array, u: Array, *, forces: Array | None = None) -> Array:
        """Return x' = f(x, u, F), (n,), SI. Source: docs/equations.md (4)-(13), (37)."""
        return self._compiled["derivative"].flat(*self._arguments(x, u, forces))

    def derivatives(self, x: Array, u: Array, forces: Sequence[Array]) -> Array:
        """Return f(x, u, F), SI, under several external forces, in one call: (forces, n).

        All have the errors of mass and drag of the first. The bits are those of `derivative`.
        """
        count = len(forces)
        if count not in self._derivatives_by_count:
            self._derivatives_by_count[count] = self._derivatives_of(count)

        p, _ = self._acting(forces[0])
        bodies = len(self._no_forces)
        on_bodies = [_zeroed(each[:bodies], self._unforced) for each in forces]
        flat = self._derivatives_by_count[count].flat(
            x, _zeroed(u, self._off), p, np.concatenate(on_bodies)
        )
        return flat.reshape(count, -1)

    def _derivatives_of(self, count: int) -> Compiled:
        """Return f of one state under that many forces."""
        derivative = self._built["derivative"]
        x, u, p = (ca.MX.sym(name, derivative.size1_in(i)) for i, name in enumerate("xup"))
        F = ca.MX.sym("F", derivative.size1_in(3), count)
        same = [ca.repmat(argument, 1, count) for argument in (x, u, p)]
        f = derivative.map(count)(*same, F)
        return Compiled(ca.Function("derivatives", [x, u, p, F], [f]))

    def tensions(self, x: Array, u: Array, *, forces: Array | None = None) -> Array:
        """Return the rod tensions, (N,), N.

        Positive when the rod pulls. Source: docs/equations.md (9), (37).
        """
        return self._compiled["tensions"].flat(*self._arguments(x, u, forces))

    def outputs(self, x: Array) -> Array:
        """Return y = h(x), (4 N + 9,), SI. Source: docs/equations.md (14)."""
        return self._compiled["outputs"].flat(x, self._p)

    def outputs_along(self, X: Array) -> Array:
        """Return the outputs of several states, (k, n), in one call: (k, 4 N + 9).

        The bits are those of `outputs`.
        """
        count = len(X)
        if count not in self._outputs_by_count:
            outputs = self._built["outputs"]
            x = ca.MX.sym("x", outputs.size1_in(0), count)
            p = ca.MX.sym("p", outputs.size1_in(1), 1)
            y = outputs.map(count)(x, ca.repmat(p, 1, count))
            self._outputs_by_count[count] = Compiled(ca.Function("outputs", [x, p], [y]))
        return self._outputs_by_count[count].flat(X.reshape(-1), self._p).reshape(count, -1)

    def velocities(self, x: Array) -> Array:
        """Return the velocities of the centres of mass, (1 + N, 3), inertial frame, m/s.

        Source: docs/equations.md (39).
        """
        return self._compiled["velocities"](x, self._p)[0]

    def sense(self, x: Array, u: Array, *, forces: Array | None = None) -> tuple[Array, Array]:
        """Return the sensors' measurements and their derivatives by (x, F).

        (15 N,), and (15 N, n + 3 + 3 N), SI. Source: docs/equations.md (61).
        """
        arguments = self._arguments(x, u, forces)
        y, held, by_acceleration, acceleration = self._compiled["sense"](*arguments)

        # dy/d(x, F) = dy/d(x, F) with a held  +  dy/da  da/d(x, F)
        slopes: Array = by_acceleration @ acceleration
        slopes[self._held_rows, self._held_columns] += held
        return y, slopes

    def sensed(self, x: Array, u: Array, *, forces: Array | None = None) -> Array:
        """Return the measurements of `sense` alone, (15 N,)."""
        return self._compiled["sensed"].flat(*self._arguments(x, u, forces))

    def linearise(self, x: Array, u: Array, *, forces: Array | None = None) -> Linearisation:
        """Return exact derivatives about (x, u) under constant forces.

        Source: docs/equations.md (15)-(15b), (37); paper (13).
        """
        function = self._compiled["linearise"]
        f, y, first_factor = function.parts[:3]
        results = function.flat(*self._arguments(x, u, forces))

        values = results[first_factor.start :]
        values[self._without_effect] = 0.0
        jacobians = Jacobians(pattern=self._pattern, values=values)
        return Linearisation(f=results[f], y=results[y], jacobians=jacobians)

    def force_effect(self, x: Array, u: Array) -> Array:
        """Return df/dF, (n, 3 + 3 N), SI per N, exact, as f is affine in the forces.

        Source: docs/equations.md (38).
        """
        f = self.derivative(x, u)
        columns = []
        for unit in np.eye(len(self._no_forces)):
            columns.append(self.derivative(x, u, forces=unit) - f)
        return np.column_stack(columns)

    def integrate(
        self,
        x: Array,
        u: Array,
        duration_s: float,
        steps: int,
        *,
        forces: Array | None = None,
        tolerance: float = math.inf,
    ) -> tuple[Array, float]:
        """Return the state after `duration_s` of constant input, (n,), and the largest local error.

        `steps`, at least 1, are equal Dormand-Prince steps of order 5, each halved where its estimated
        error exceeds the tolerance; the rods are projected back after each. Source:
        docs/equations.md (13b), (13c).
        """
        limits = StepLimits(tolerance=tolerance)
        return integration.integrate(self.step(u, forces), x, duration_s, steps, limits)

    def advance(
        self, x: Array, u: Array, duration_s: float, steps: int, *, forces: Array | None = None
    ) -> Array:
        """Return the state of `integrate` by equal steps, (n,), without the error: (13b)."""
        after_step = self.stepper(duration_s / steps, forces)
        for _ in range(steps):
            x = after_step(x, u)
        return x

    def step(self, u: Array, forces: Array | None = None) -> Step:
        """Return a step under constant input and forces, for `model.physics.integration`: (13b)."""
        function = self._compiled["step"]
        u = _zeroed(u, self._off)
        p, F = self._acting(forces)
        n = self.system.n

        def step(x: Array, h: float) -> tuple[Array, Array]:
            results = function.flat(x, u, p, F, h)
            return results[:n], results[n:]

        return step

    def stepper(
        self, duration_s: float, forces: Array | None = None
    ) -> Callable[[Array, Array], Array]:
        """Return the map from state and input to the state after one step, without its error."""
        function = self._compiled["advance"]
        p, F = self._acting(forces)

        def after_step(x: Array, u: Array) -> Array:
            return function.flat(x, _zeroed(u, self._off), p, F, duration_s)

        return after_step

    def rollout(
        self, x: Array, feedback: Feedback, duration_s: float, forces: Array | None
    ) -> tuple[Array, Array] | None:
        """Return states, (steps + 1, n), and inputs, (steps, m), under a feedback, in one call.

        None where the step is not compiled, or UAVs are off.
        """
        if self._compiled_step is None or len(self._off):
            return None
        return self._compiled_step.rollout(x, feedback, duration_s, self._acting(forces))

    @cached_property
    def _compiled_step(self) -> CompiledStep | None:
        return CompiledStep.load(self.system.kind)


def _zeroed(vector: Array, entries: npt.NDArray[np.intp]) -> Array:
    """Return the vector with some entries zero; a copy only if there are any."""
    if len(entries):
        vector = vector.copy()
        vector[entries] = 0.0
    return vector
