"""One controller for any set of owned UAVs: one is the paper's distributed controller, all the centralized one."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from model.arrays import Array, checked
from model.discretisation import Discrete, euler, zero_order_hold
from model.failure import failed_model
from model.hover import Hover
from model.linearisation import Linearisation, Model
from model.state import LARGEST, input_indices
from mpc import condensing
from mpc.constraints import Affine, UserCosts, compile_constraints, pairs_of, rate_rows, separation_rows, tilt_states
from mpc.cost import Cost
from mpc.feedback import FeedbackLaw
from mpc.prediction import Prediction, closed_loop, free_response, open_loop
from mpc.qp import QP, Solution
from mpc.regulation import CostToGo, Regulation
from mpc.settings import ControllerSettings, SettingsError
from mpc.solvers import solve, unsolved


@dataclass(frozen=True, slots=True, kw_only=True)
class Linear:
    """Everything linearised about one (x0, u0).

    Attributes:
        x0: State of the linearisation, (n,).
        u0: Input of the linearisation, (m,).
        model: f, A_c, B_c, y, C.
        on_state, on_input: The user's constraints.
        costs: The user's terms of the cost.
        u_target: Input that costs nothing, (m,).
    """

    x0: Array
    u0: Array
    model: Linearisation
    costs: Affine
    on_state: Affine
    on_input: Affine
    u_target: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class StepResult:
    """What one step found.

    Attributes:
        U: Absolute inputs of the owned UAVs to announce and apply, (N_p, 4 owned); after a failed solve
            the previous plan, shifted.
        c: Corrections to the shared law that go with them, (N_p, 4 owned); (0, 4 owned) without that law.
        solution: The solver's answer, solved or not.
    """

    U: Array
    c: Array
    solution: Solution


class Controller:
    """Model predictive control of the owned UAVs, everyone else's inputs taken as announced.

    The stages are separate so that whoever runs them can time them; `step` does all.

    Args:
        model: The system as the controller knows it.
        hover: Its equilibrium.
        settings: Rates, weights, limits.
        owned: UAVs this controller decides for, 0-based, ascending.
        X_ref: Reference states at instants 0..K-1 of the maneuver, (K, n), for the preview.
    Raises: SettingsError: UAVs that do not exist, or a constraint that cannot be read.
    """

    def __init__(
        self,
        model: Model,
        hover: Hover,
        settings: ControllerSettings,
        owned: Sequence[int],
        X_ref: Array | None = None,
    ) -> None:
        if not owned or list(owned) != sorted(set(owned)) or not 0 <= owned[0] <= owned[-1] < model.system.N:
            raise SettingsError(f"owned: expected ascending indices below {model.system.N}, got {list(owned)}")
        self.model = self._whole = model
        self._gone = self._off = self._released = frozenset[int]()
        self._relaxation = settings.relaxation
        self.settings = settings
        self.owned = tuple(owned)
        self.own = input_indices(self.owned)
        self._others = np.setdiff1d(np.arange(model.system.m), self.own)
        self.cost = Cost(settings.weights, hover)
        self.regulation = Regulation(model, hover, settings, X_ref)
        self._costs = UserCosts(settings.costs, model)
        # Outputs without a weight stay out of the program; the positions of the UAVs always have one.
        self._weighted = np.flatnonzero(self.cost.Q)
        self._positions = 3 * model.system.N
        self._Q = np.concatenate([self.cost.Q[self._weighted], self._costs.weights])
        self._answering = self._others
        self._on_state, self._on_input = compile_constraints(settings.constraints, model)
        # What the others do to a constraint without owned inputs is theirs to keep.
        depends = self._on_input.depends
        self._inputs_kept = depends[:, self.own].any(axis=1) if len(depends) else np.zeros(0, dtype=bool)
        N, steps = model.system.N, settings.horizon
        self._lower, self._upper = settings.limits.lower(len(self.owned)), settings.limits.upper(len(self.owned))
        self._rate = settings.limits.step(len(self.owned), settings.sampling_period_s)
        # Decisions in units of half their range, so that Newtons and Newton metres weigh alike.
        self._scale = (self._upper - self._lower) / 2.0
        self._pairs = pairs_of(N, self.owned)
        self._separation = settings.separation if len(self._pairs) else None
        self._tilt = settings.tilt
        self._tilt_states = tilt_states(self.owned)
        # One slack for all separations, one for all tilts, one for each softened constraint of the user's.
        soft = ~np.isnan(self._on_state.penalty)
        shared = [limit.penalty for limit in (self._separation, self._tilt) if limit is not None]
        self._penalties = np.concatenate([shared, self._on_state.penalty[soft]])
        self._tilt_slack = 0 if self._separation is None else 1
        self._state_slack = np.where(soft, len(shared) + np.cumsum(soft) - 1, -1)
        self._z_scale = np.concatenate([np.tile(self._scale, steps), np.ones(len(self._penalties))])
        # Of the effort, twice, as solvers have a half in front: slope and curvature by the scaled decision.
        self._effort_slope = 2.0 * self.cost.R[self.own] * self._scale
        self._effort_curvature = np.tile(self._effort_slope * self._scale, steps)
        self._template = self._rows_template()
        self._rates = np.tile(self._rate, steps - 1)
        slacks = len(self._penalties)
        self._slack_bounds = np.zeros(slacks), np.full(slacks, np.inf)
        self._no_gap = np.full(steps * len(self._pairs), np.inf)
        self._no_tilt = np.full(steps * len(self._tilt_states), np.inf)

    def step(
        self,
        x0: Array,
        u0: Array,
        U: Array,
        y_ref: Array,
        law: FeedbackLaw | None = None,
        forces: Array | None = None,
        ticks_since_start: int | None = None,
        end: CostToGo | None = None,
    ) -> StepResult:
        """One step of the controller.

        Args:
            x0: State at the first step of the horizon, (n,).
            u0: Inputs in force just before it, all UAVs, (m,): linearisation point and origin of the rates.
            U: Announced inputs of all UAVs over the horizon, (N_p, m); the owned columns hold the
                previous plan, shifted.
            y_ref: Reference outputs at steps 0..N_p, (N_p + 1, p).
            law: With closed-loop prediction, the shared law over the horizon (`law`).
            forces: Estimated external forces, (3 + 3 N,), inertial frame, N; None when nobody estimates them.
            ticks_since_start: Ticks since this controller began; see `conclude`.
            end: With terminal "riccati", the cost after the horizon (`end`).
        Returns: The plan and how it was found. Never raises for a problem without solution.
        Raises: ShapeError: an argument of the wrong shape or not finite.
        """
        x0, u0, U, y_ref = self.check(x0, u0, U, y_ref)
        linear = self.linearise(x0, u0, forces)
        prediction = self.predict(linear, self.discretise(linear), U, law)
        qp = self.condense(linear, prediction, U, y_ref, law, end)
        return self.conclude(self.solve(qp), prediction, U, law, ticks_since_start)

    def law(self, x0: Array, x_ref: Array, c: Array, forces: Array | None = None, start: int = 0) -> FeedbackLaw | None:
        """The shared control law over the horizon, or None with open-loop prediction; see `Regulation.law`."""
        return self.regulation.law(x0, x_ref, c, forces, start)

    def end(self, x0: Array, x_ref: Array, forces: Array | None = None, instant: int = 0) -> CostToGo | None:
        """The cost after the horizon, or None where it is a multiple of the stage cost; see `Regulation.cost_to_go`."""
        return self.regulation.cost_to_go(x0, x_ref, forces, instant)

    def without(self, uavs: Collection[int]) -> None:
        """From now on some UAVs, 0-based, have no agent: they follow the fail-safe, and are predicted so."""
        self._gone = frozenset(uavs)
        # UAVs without agents are in the others' way: several correct the same distances, each its share of them.
        share = len(self.owned) / self._whole.system.N if uavs and self.settings.prediction == "closed_loop" else 1.0
        self._relaxation = min(self.settings.relaxation, share)
        self._answering = np.setdiff1d(self._others, input_indices(sorted(uavs)))
        self._form()

    def fail(self, off: Collection[int], released: Collection[int]) -> None:
        """From now on some UAVs, 0-based, have no motors, and some of those are no longer on their rods.

        Where the UAVs that are left cannot stabilise the team, cost and control law do not know; the model does.

        Args:
            off: UAVs without motors, the released ones among them.
            released: UAVs cut loose.
        Source: docs/equations.md (50), (51).
        """
        self._off, self._released = frozenset(off), frozenset(released)
        self.model = failed_model(self._whole.system, off, released) if off else self._whole
        self._form()

    def _form(self) -> None:
        self.regulation.form(self._gone, self._off, self._released)
        self.cost = self.regulation.cost
        self._Q = np.concatenate([self.cost.Q[self._weighted], self._costs.weights])

    def foreseen(self, prediction: Prediction, law: FeedbackLaw, inputs: Array) -> Array:
        """Inputs of all UAVs over the horizon as this controller expects them, within bounds, (N_p, m).

        Args:
            prediction: Of the team.
            law: The shared control law over the horizon.
            inputs: Of the owned UAVs, (N_p, m_own).
        Source: docs/equations.md (35), (36).
        """
        dX = free_response(prediction.A, prediction.W + (inputs - prediction.U_free) @ prediction.B.T)
        U = np.empty_like(law.c)
        U[:, self.own] = inputs
        U[:, self._others] = law.inputs(self._others) + dX[:-1] @ law.K[self._others].T
        limits, uavs = self.settings.limits, self._whole.system.N
        return np.clip(U, limits.lower(uavs), limits.upper(uavs))

    def adapted(
        self, law: FeedbackLaw, discrete: Discrete, u0: Array, U: Array, columns: npt.NDArray[np.intp]
    ) -> FeedbackLaw:
        """The law with corrections that make some inputs what they were announced to be, whatever law that was under.

        Args:
            law: The shared law over the horizon.
            discrete: Zero-order hold about (x0, u0).
            u0: Input of the linearisation, (m,).
            U: Announced inputs of all UAVs over the horizon, (N_p, m).
            columns: Inputs whose corrections to find.
        Source: docs/equations.md (46).
        """
        dX = free_response(discrete.A, discrete.f_d + (U - u0) @ discrete.B.T)
        c = law.c.copy()
        c[:, columns] = U[:, columns] - law.uncorrected(columns) - dX[:-1] @ law.K[columns].T
        return replace(law, c=c)

    def check(self, x0: Array, u0: Array, U: Array, y_ref: Array) -> tuple[Array, Array, Array, Array]:
        """The arguments of `step`, their shapes and values checked."""
        system, steps = self.model.system, self.settings.horizon
        return (
            checked("x0", x0, (system.n,)),
            checked("u0", u0, (system.m,)),
            checked("U", U, (steps, system.m)),
            checked("y_ref", y_ref, (steps + 1, system.p)),
        )

    def linearise(self, x0: Array, u0: Array, forces: Array | None = None) -> Linear:
        """Expand model and constraints about (x0, u0), under estimated external forces.

        Source: docs/equations.md (15), (30), (37), (40); paper (13), (20).
        """
        u_target = self.cost.u_target
        if forces is not None and self.settings.weights.penalised_input == "deviation":
            u_target = u_target + self.regulation.target.M_u @ forces
        return Linear(
            x0=x0,
            u0=u0,
            model=self.model.linearise(x0, u0, forces=forces),
            on_state=self._on_state.at(x0),
            on_input=self._on_input.at(u0),
            costs=self._costs.at(x0),
            u_target=u_target,
        )

    def discretise(self, linear: Linear) -> Discrete:
        """Difference equation over the sampling period. Source: docs/equations.md (16)-(17)."""
        method = zero_order_hold if self.settings.discretisation == "exact" else euler
        return method(linear.model, self.settings.sampling_period_s)

    def predict(self, linear: Linear, discrete: Discrete, U: Array, law: FeedbackLaw | None) -> Prediction:
        """Predict the team over the horizon. Source: docs/equations.md (22)-(24), (35)-(36)."""
        if law is None:
            return open_loop(discrete, linear.u0, self.own, self._others, U)
        return closed_loop(discrete, linear.u0, self.own, self._others, law)

    def condense(
        self,
        linear: Linear,
        prediction: Prediction,
        U: Array,
        y_ref: Array,
        law: FeedbackLaw | None = None,
        end: CostToGo | None = None,
    ) -> QP:
        """The QP in the scaled decision and the slacks.

        Args:
            linear: The expansion.
            prediction: Of the team.
            U: Announced inputs of all UAVs over the horizon, (N_p, m).
            y_ref: Reference outputs at steps 0..N_p, (N_p + 1, p).
            law: With closed-loop prediction, the shared control law over the horizon.
            end: With terminal "riccati", the cost after the horizon.
        Source: docs/equations.md (22)-(30), (48); paper (22)-(27).
        """
        C, error_0 = linear.model.C[self._weighted], (linear.model.y - y_ref)[1:, self._weighted]
        Q, terminal = self._Q, self.settings.weights.terminal
        if len(self._costs):
            # The user's terms are further outputs, whose reference is zero.
            C = np.concatenate([C, linear.costs.slope])
            error_0 = np.hstack([error_0, np.tile(linear.costs.value, (len(error_0), 1))])
        error = error_0 + prediction.dX_free[1:] @ C.T
        if end is not None:
            terminal = 0.0  # the stage cost of the last state is part of the cost-to-go
            if law is not None and len(self._answering):
                # The others' effort, which answers to the state, has its weight in the regulator's cost as well.
                C, error, Q = self._with_effort(C, error, linear, prediction, law)
        steps, m = prediction.U_free.shape
        decisions, slacks = steps * m, len(self._penalties)

        weighted = error * Q
        weighted[-1] *= terminal
        # Decisions in their units from here on, and twice the cost, as solvers have a half in front.
        scaled = (C @ prediction.impulse) * self._scale
        H, g = np.zeros((decisions + slacks, decisions + slacks)), np.empty(decisions + slacks)
        condensing.condense(scaled, 2.0 * Q, terminal, 2.0 * weighted, H, g)
        if end is not None:
            # Effect of all decisions on the last state, the first one's first.
            last = (prediction.impulse[::-1].transpose(1, 0, 2) * self._scale).reshape(-1, decisions)
            reached = end.root @ last
            H[:decisions, :decisions] += 2.0 * (reached.T @ reached)
            g[:decisions] += 2.0 * (reached.T @ (end.root @ (end.error + prediction.dX_free[-1])) + end.slope @ last)
        diagonal = H.reshape(-1)[:: decisions + slacks + 1]
        diagonal[:decisions] += self._effort_curvature
        diagonal[decisions:] = self._penalties
        g[:decisions] += (self._effort_slope * (prediction.U_free - linear.u_target[self.own])).reshape(-1)
        g[decisions:] = self._penalties

        lower, upper = self._bounds(prediction, linear.u0)
        rows, row_lower, row_upper = self._rows(linear, prediction, scaled[:, : self._positions], U)
        return QP(H=H, g=g, lower=lower, upper=upper, A=rows, row_lower=row_lower, row_upper=row_upper)

    def _with_effort(
        self, C: Array, error: Array, linear: Linear, prediction: Prediction, law: FeedbackLaw
    ) -> tuple[Array, Array, Array]:
        """Outputs, errors at steps 1..N_p and weights, extended by the inputs of the others that have agents.

        Source: docs/equations.md (36e).
        """
        among_others = np.searchsorted(self._others, self._answering)
        effort = prediction.U_others[:, among_others] - linear.u_target[self._answering]
        effort = np.concatenate([effort[1:], np.zeros((1, len(self._answering)))])  # step N_p has no input
        return (
            np.concatenate([C, law.K[self._answering]]),
            np.hstack([error, effort]),
            np.concatenate([self._Q, self.cost.R[self._answering]]),
        )

    def solve(self, qp: QP) -> Solution:
        """Solve by the chosen solver, or by Clarabel when that fails."""
        return solve(qp, self.settings.solver)

    def conclude(
        self,
        solution: Solution,
        prediction: Prediction,
        U: Array,
        law: FeedbackLaw | None,
        ticks_since_start: int | None = None,
    ) -> StepResult:
        """Turn an answer into the plan to announce: relaxed, or the shifted previous plan after a failure.

        Args:
            solution: Of the program.
            prediction: It was made of.
            U: Announced inputs of all UAVs over the horizon, (N_p, m).
            law: With closed-loop prediction, the shared law over the horizon.
            ticks_since_start: Ticks since this controller joined. In the first ones the relaxation weight is at least
                1 / (ticks + 1), as there is no previous plan to average with. None for a member from the start.
        Source: docs/equations.md (30a), (36a).
        """
        w = self._relaxation
        if ticks_since_start is not None:
            w = max(w, 1.0 / (ticks_since_start + 1))
        optimum = self._optimum(solution, prediction, U, law, w)
        if np.isfinite(optimum.U).all() and np.abs(optimum.c).max(initial=0.0) <= LARGEST:
            return optimum
        return replace(self.give_up(U, law), solution=solution)

    def give_up(self, U: Array, law: FeedbackLaw | None) -> StepResult:
        """The answer where there is no problem to solve, its numbers being beyond all bounds: the previous plan."""
        m = len(self.own)
        return StepResult(
            U=np.clip(U[:, self.own], self._lower, self._upper),
            c=np.zeros((0, m)) if law is None else law.c[:, self.own],
            solution=unsolved(0, 0, self.settings.solver),
        )

    def _optimum(
        self, solution: Solution, prediction: Prediction, U: Array, law: FeedbackLaw | None, relaxation: float
    ) -> StepResult:
        steps, m = prediction.U_free.shape
        solved = solution.status == "solved"
        w = relaxation if solved else 0.0
        # The solver meets the bounds to its tolerance; the plant's actuators have them exactly.
        v = (solution.z * self._z_scale)[: steps * m].reshape(steps, m) if solved else np.zeros((steps, m))
        best = np.clip(prediction.U_free + v, self._lower, self._upper)
        if law is None:
            previous = U[:, self.own]
            inputs = np.clip(w * best + (1.0 - w) * previous, self._lower, self._upper) if solved else previous.copy()
            return StepResult(U=inputs, c=np.zeros((0, m)), solution=solution)
        c_best = np.zeros((steps, m))
        K, at_x0 = law.K[self.own], law.uncorrected(self.own)
        if solved:
            dX = free_response(prediction.A, prediction.W + (best - prediction.U_free) @ prediction.B.T)
            c_best = best - at_x0 - dX[:-1] @ K.T
        if w == 1.0:
            return StepResult(U=best, c=c_best, solution=solution)
        # Relax the corrections only, so that the stabilising feedback acts in full, and see what inputs follow.
        c = w * c_best + (1.0 - w) * law.c[:, self.own]
        drive = at_x0 + c
        closed = prediction.A + prediction.B @ K
        dX = free_response(closed, prediction.W + (drive - prediction.U_free) @ prediction.B.T)
        inputs = drive + dX[:-1] @ K.T
        changes = np.diff(inputs, axis=0, prepend=prediction.U_free[:1])
        within = (self._lower <= inputs) & (inputs <= self._upper) & (np.abs(changes) <= self._rate)
        if not within.all():
            inputs = self._limited(prediction, K, drive)
        return StepResult(U=inputs, c=c, solution=solution)

    def _limited(self, prediction: Prediction, K: Array, drive: Array) -> Array:
        """Inputs that follow from the own law within bounds and rates, one step after the other, (N_p, m_own).

        Args:
            prediction: Of the team.
            K: Feedback of the owned inputs, (m_own, n).
            drive: What the law gives without it, (N_p, m_own).
        """
        inputs = np.empty_like(drive)
        dx, before = np.zeros(len(prediction.A)), prediction.U_free[0]
        for k, free in enumerate(prediction.U_free):
            # What is mixed in may be of another team than now flies: rates hold all the same.
            wanted = np.clip(drive[k] + K @ dx, before - self._rate, before + self._rate)
            inputs[k] = before = np.clip(wanted, self._lower, self._upper)
            dx = prediction.A @ dx + prediction.W[k] + prediction.B @ (inputs[k] - free)
        return inputs

    def _bounds(self, prediction: Prediction, u0: Array) -> tuple[Array, Array]:
        """Bounds on the scaled decision; the first step's rate limit is a bound too."""
        lower, upper = self._lower - prediction.U_free, self._upper - prediction.U_free
        # Inputs in force outside the limits come back at once: bounds are the actuator's, rates a wish.
        first = u0[self.own] - prediction.U_free[0]
        lower[0] = np.minimum(np.maximum(lower[0], first - self._rate), upper[0])
        upper[0] = np.maximum(np.minimum(upper[0], first + self._rate), lower[0])
        from_slack, to_slack = self._slack_bounds
        return (
            np.concatenate([(lower / self._scale).reshape(-1), from_slack]),
            np.concatenate([(upper / self._scale).reshape(-1), to_slack]),
        )

    def _rows(
        self, linear: Linear, prediction: Prediction, position_impulse: Array, U: Array
    ) -> tuple[Array, Array, Array]:
        """Rate limits, separation, tilt, and the user's constraints, stacked.

        Args:
            linear: The expansion.
            prediction: Of the team.
            position_impulse: Effect of the scaled decision on the positions of the UAVs, (N_p, 3 N, m_own).
            U: Announced inputs.
        """
        steps, m = prediction.U_free.shape
        drift = (prediction.U_free[1:] - prediction.U_free[:-1]).reshape(-1)
        lower, upper = [-self._rates - drift], [self._rates - drift]
        A, at = self._template.copy(), len(drift)
        if self._separation is not None:
            positions, C = linear.model.y[: self._positions], linear.model.C[: self._positions]
            _, direction = separation_rows(positions, self._pairs)
            distance = (positions + prediction.dX_free[1:] @ C.T) @ direction.T
            gap = self._separation.minimum_m - distance.reshape(-1)
            at = _fill(direction @ position_impulse, A, at)
            lower.append(gap)
            upper.append(self._no_gap)
        if self._tilt is not None:
            angles = (linear.x0[self._tilt_states] + prediction.dX_free[1:, self._tilt_states]).reshape(-1)
            limit = math.radians(self._tilt.limit_deg)
            effect = prediction.impulse[:, self._tilt_states] * self._scale
            at = _fill(effect, A, _fill(effect, A, at))
            lower += [-self._no_tilt, -limit - angles]
            upper += [limit - angles, self._no_tilt]
        if len(self._on_state):
            on = linear.on_state
            value = on.value + prediction.dX_free[1:] @ on.slope.T
            at = _fill(on.slope @ prediction.impulse * self._scale, A, at)
            lower.append(np.where(self._on_state.equality, -value, -np.inf).reshape(-1))
            upper.append(-value.reshape(-1))
        if self._inputs_kept.any():
            kept, on = self._inputs_kept, linear.on_input
            dU = U - linear.u0
            dU[:, self._others] = prediction.U_others - linear.u0[self._others]
            dU[:, self.own] = prediction.U_free - linear.u0[self.own]
            value = on.value[kept] + dU @ on.slope[kept].T
            A[at:, : steps * m] = np.kron(np.eye(steps), on.slope[kept][:, self.own] * self._scale)
            lower.append(np.where(self._on_input.equality[kept], -value, -np.inf).reshape(-1))
            upper.append(-value.reshape(-1))
        return A, np.concatenate(lower), np.concatenate(upper)

    def _rows_template(self) -> Array:
        """What the rows have in common at every step: rate limits, and where slacks soften; zeros are filled in.

        A lower bound is relieved by adding the slack, an upper bound by taking it off.
        """
        steps, m = self.settings.horizon, len(self.own)
        slacks = len(self._penalties)
        parts = [np.hstack([rate_rows(steps, m) * self._z_scale[: steps * m], np.zeros(((steps - 1) * m, slacks))])]

        def soften(slack: npt.NDArray[np.intp], sign: float) -> None:
            rows = np.zeros((len(slack), steps * m + slacks))
            soft = slack >= 0
            rows[np.flatnonzero(soft), steps * m + slack[soft]] = sign
            parts.append(rows)

        if self._separation is not None:
            soften(np.zeros(steps * len(self._pairs), dtype=np.intp), 1.0)
        if self._tilt is not None:
            for sign in (-1.0, 1.0):
                soften(np.full(steps * len(self._tilt_states), self._tilt_slack), sign)
        soften(np.tile(self._state_slack, steps), -1.0)
        soften(np.full(steps * int(self._inputs_kept.sum()), -1), 1.0)
        return np.concatenate(parts)


def _fill(impulse: Array, A: Array, at: int) -> int:
    """Write the prediction matrix of a signal into rows that begin at `at`; returns where the next begin."""
    steps, signals, _ = impulse.shape
    end: int = at + steps * signals
    condensing.fill(impulse, A[at:end])
    return end
