"""Prediction and QP of one step by the compiled kernels, in arrays that the next step overwrites.

`kernels.c` computes what `prediction`, `horizon_and_terminal_cost` and `relaxation` and the constraints with
`in_kernel` do, with fewer operations. Quantities that are those of the step before (derivatives at
hover, gains, weights) are not computed again.
"""

import ctypes
from dataclasses import replace

import numpy as np

from transport.model.arrays import Array, frozen
from transport.model.kernels import native
from transport.model.linear.discretisation import Discrete
from transport.mpc.program.constraints.input_limits import Rates
from transport.mpc.program.constraints.separation import Separation
from transport.mpc.program.constraints.stack import Stack
from transport.mpc.program.constraints.tilt import Tilt
from transport.mpc.program.decision import Decision
from transport.mpc.program.feedback_law import FeedbackLaw
from transport.mpc.program.horizon_and_terminal_cost import CostToGo, Objective
from transport.mpc.program.prediction import Linear, Prediction
from transport.mpc.program.quadratic_program import QP

_NO_GAIN = np.zeros((0, 0))
frozen(_NO_GAIN)


class CompiledProgram:
    """The struct `problem` of the kernels, its arrays, and the QP and prediction in them.

    The names are those of `struct problem` in model/kernels/kernels.c. An array is handed over in one of these
    ways:

    - `_set`: one of the struct's own, constant or written by the kernels;
    - `_input`: the caller's, mostly that of the step before; `_changed` gathers those that are new over
      `respond` and `condense`, so that the kernels keep what follows from the others;
    - `_like_before`: as `_input`, of an array that is mostly equal to the one before, but another object;
    - `_copies.copied`: a copy of one that is new at each step.

    Args:
        n: States of the prediction, with those of known motors.
        outputs: Outputs with a weight.
        terms: Number of the user's terms of the cost.
        effort: Weights on the owned inputs times their scale, (m_own,).
    """

    def __init__(
        self,
        decision: Decision,
        stack: Stack,
        n: int,
        outputs: native.Places,
        terms: int,
        effort: Array,
    ) -> None:
        self._decision = decision
        self._n = n
        self._terms = terms
        self._stack = stack
        self._by_kernel = [each for each in stack.constraints if each.in_kernel]
        self._law: FeedbackLaw | None = None  # of the newest prediction
        self._newest: Prediction | None = None
        # Inputs of the kernels that are mostly the arrays of the step before.
        self._kept = native.Addresses()
        self._changed: set[str] = set()  # those of them that changed since the QP before
        self._copies = native.Addresses()  # of inputs that are new at each step

        self._arrays: dict[str, np.ndarray] = {}  # alive as long as the struct has their addresses
        # Inputs and corrections that `conclude` writes.
        self._plan = np.empty(decision.shape), np.empty(decision.shape)
        self._addresses_of_plan = [native.address(part) for part in self._plan]
        self._problem = native.Problem()
        self._set_constants(outputs, effort)
        self._closed = self._set_prediction()
        self._open = replace(
            self._closed, feedback=self._closed.feedback[:0], dU_free=self._closed.dU_free[:, :0]
        )
        self.qp = self._set_program()
        self._set_work_space()

    def is_newest(self, prediction: Prediction) -> bool:
        """Return whether a prediction is the newest of the kernels: its numbers still hold."""
        return prediction is self._newest

    def respond(
        self,
        linear: Linear,
        discrete: Discrete,
        U: Array,
        law: FeedbackLaw | None,
        *,
        only_new: bool,
    ) -> tuple[Prediction, bool]:
        """Return the prediction of a step, and whether the difference equation or the gain is new.

        With `only_new` nothing is computed if neither is new: the caller writes the free response
        along a trajectory by `mpc.program.prediction.follow`.
        Source: docs/equations.md (22)-(24), (35).
        """
        copied = self._copies.copied
        problem = self._problem
        problem.A = self._input("A", discrete.A)
        problem.B = self._input("B", discrete.B)
        problem.K = self._input("K", _NO_GAIN if law is None else law.K)
        problem.f_d = copied("f_d", discrete.f_d)
        problem.u0 = copied("u0", linear.u0)
        problem.uncorrected = 0 if law is None else copied("uncorrected", law.uncorrected)
        problem.announced = copied("announced", U if law is None else law.c)

        is_new = not self._changed.isdisjoint(("A", "B", "K"))
        if is_new or not only_new:
            native.KERNELS.respond(ctypes.addressof(problem))
        self._newest = self._open if law is None else self._closed
        self._law = law
        return self._newest, is_new

    def condense(self, objective: Objective) -> None:
        """Write Hessian, gradient, bounds and the rows of constraints with `in_kernel` into the QP.

        Effects and Hessian of the step before are kept if their data are the same arrays, as about hover.
        Source: docs/equations.md (26)-(30), (36e), (48).
        """
        copied = self._copies.copied
        problem = self._problem
        linear = objective.linear
        problem.terminal = objective.terminal
        problem.inputs = len(objective.responding)
        problem.answering = self._input("answering", objective.responding)
        problem.Q = self._input("Q", objective.Q)
        problem.slope = self._input("slope", self._like_before("slope", objective.slopes))
        problem.at_x0 = copied("at_x0", objective.terms)
        problem.x0 = copied("x0", linear.x0)
        problem.y = copied("y", linear.model.y)
        problem.y_ref = copied("y_ref", objective.y_ref)
        problem.u_target = copied("u_target", linear.u_target)
        problem.model_outputs = len(linear.model.y)
        self._set_end(objective.end)

        # Rows of C among those of all factors of the linearisation.
        pattern = linear.model.jacobians.pattern
        begin, problem.index = pattern.addresses
        problem.begin = begin + np.dtype(np.intp).itemsize * pattern.first_rows[-2]
        problem.value = self._input("value", linear.model.jacobians.values)

        problem.known = not self._changed
        native.KERNELS.fill(ctypes.addressof(problem))
        self._changed.clear()

    def relaxed(self, z: Array, w: float) -> tuple[Array, Array]:
        """Return inputs and corrections, (N_p, m_own), as `mpc.program.relaxation.relaxed`."""
        z_address = self._copies.copied("z", z)
        native.KERNELS.conclude(
            ctypes.addressof(self._problem), z_address, w, *self._addresses_of_plan
        )
        inputs, corrections = self._plan
        return inputs.copy(), corrections.copy()

    def follows(self, prediction: Prediction, law: FeedbackLaw) -> bool:
        """Return whether prediction and law are those of the newest `respond`."""
        return self.is_newest(prediction) and law is self._law

    def _input(self, name: str, array: np.ndarray) -> int:
        """Return the address of an input of the kernels, and note whether it changed.

        Only a read-only array that is the same object has certainly the same numbers.
        """
        kept = self._kept.address_of(name, array)
        if kept is not None and not array.flags.writeable:
            return kept
        self._changed.add(name)
        return self._kept.of(name, array)

    def _like_before(self, name: str, array: Array) -> Array:
        """Return the array of the step before if it has the same numbers, as of linear terms."""
        before = self._kept.array(name)
        if before is array:
            return array
        if before is not None and before.tobytes() == array.tobytes():
            return before
        frozen(array)
        return array

    def _set_end(self, end: CostToGo | None) -> None:
        """Write the cost after the horizon into the struct."""
        problem = self._problem
        problem.root = self._input("root", _NO_GAIN if end is None else end.root)
        problem.rank = 0 if end is None else len(end.root)
        if end is not None:
            problem.error = self._copies.copied("error", end.error)
            problem.end_slope = self._copies.copied("end_slope", end.slope)

    def _set(self, name: str, array: np.ndarray) -> np.ndarray:
        """Give the struct the address of an array, and keep the array alive."""
        self._arrays[name] = array
        setattr(self._problem, name, native.address(array))
        return array

    def _set_constants(self, outputs: native.Places, effort: Array) -> None:
        """Write sizes, limits and the constant arrays into the struct."""
        decision = self._decision
        problem = self._problem
        steps, m = decision.shape
        problem.steps = steps
        problem.m = m
        problem.n = self._n
        problem.size = decision.size + len(self._stack.penalties)
        problem.outputs = len(outputs)
        problem.terms = self._terms
        problem.all_inputs = decision.system.m

        self._set("chosen", outputs)
        self._set("own", decision.own)
        self._set("scale", decision.scale)
        self._set("effort", effort)
        self._set("penalties", self._stack.penalties)
        self._set("low", decision.lower)
        self._set("high", decision.upper)
        self._set("rate", decision.rate)
        for constraint in self._by_kernel:
            if isinstance(constraint, Separation):
                problem.pairs = len(constraint.pairs)
                problem.separation = constraint.minimum_m
                self._set("pair", constraint.pairs)
            elif isinstance(constraint, Tilt):
                problem.angles = len(constraint.angles)
                problem.tilt = constraint.limit_rad
                self._set("angle", constraint.angles)

    def _set_prediction(self) -> Prediction:
        """Return the prediction in arrays of the struct, with the control law."""
        steps, m = self._decision.shape
        m_all = self._decision.system.m
        return Prediction(
            effect=self._set("effect", np.empty((self._n, steps, m))),
            feedback=self._set("feedback", np.empty((m_all, steps, m))),
            dX_free=self._set("dX", np.empty((steps + 1, self._n))),
            dU_free=self._set("dU", np.empty((steps, m_all))),
            U_all=self._set("U", np.empty((steps, m_all))),
            U_free=self._set("U_free", np.empty((steps, m))),
        )

    def _set_program(self) -> QP:
        """Return the QP in arrays of the struct, with its constant entries."""
        size = self._problem.size
        rows = self._stack.empty()
        for constraint in self._by_kernel:
            if isinstance(constraint, Rates):
                self._stack.write(rows, constraint, constraint.of_inputs)
        return QP(
            H=self._set("H", np.empty((size, size))),
            g=self._set("g", np.empty(size)),
            lower=self._set("lower", np.zeros(size)),
            upper=self._set("upper", np.full(size, np.inf)),
            A=self._set("rows", rows.A),
            row_lower=self._set("row_lower", rows.lower),
            row_upper=self._set("row_upper", rows.upper),
        )

    def _set_work_space(self) -> None:
        """Give the struct room for what the kernels compute on the way."""
        decision = self._decision
        problem = self._problem
        steps, m = decision.shape
        m_all = decision.system.m
        # What has a weight: outputs, the user's terms, and the others' inputs, at most m_all.
        weighted = problem.outputs + self._terms + m_all
        in_rows = m * max(problem.pairs, problem.angles) + problem.pairs
        self._set("S", np.empty((weighted, steps, m)))
        self._set("free", np.empty((steps, problem.outputs)))
        self._set("signals", np.empty(steps * in_rows))
        # Effects of the decision on states, on what has a weight and on the root of the cost-to-go:
        # L, flat and reached in `condense` of the kernels.
        sizes = steps, self._n, m, weighted, self._n
        self._set("kept", np.empty(native.KERNELS.kept_work(*sizes)))

        for_prediction = native.KERNELS.predict_work(self._n, m_all, m)
        for_cost = native.KERNELS.condense_work(*sizes)
        problem.work = native.work("step", max(for_prediction, for_cost))
