"""One controller for any set of owned UAVs: one is the paper's distributed controller, all the centralized one."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from model import state
from model.arrays import Array
from model.discretisation import Discrete, euler, zero_order_hold
from model.flat import Track
from model.hover import Hover
from model.linearisation import Linearisation, Model
from model.motors import lagged
from model.native import Places
from model.obstacles import Obstacle
from model.state import LARGEST
from mpc.feedback import FeedbackLaw
from mpc.prediction import Linear, Prediction, convolve, free_response
from mpc.program import Program
from mpc.qp import QP, Solution, solve, unsolved
from mpc.regulation import CostToGo, Regulation
from mpc.rows import Decision
from mpc.settings import ControllerSettings
from mpc.tracking import Along, Course, rollout

# A trajectory beyond these angles of payload or UAVs, rad, is not followed: Euler angles become singular.
_STEEPEST = 1.3


@dataclass(frozen=True, slots=True, kw_only=True)
class StepResult:
    """Plan of one step."""

    U: Array  # inputs of the owned UAVs to announce and apply, (N_p, 4 owned); after a failed solve the previous plan
    c: Array  # their corrections to the shared control law, (N_p, 4 owned); (0, 4 owned) without that law
    solution: Solution  # of the QP, solved or not


class Controller:
    """Model predictive control of the owned UAVs, given the announced inputs of the others.

    The preview follows X_ref, (K, n), the control law a flat track, clear of obstacles. Raises: SettingsError.
    """

    def __init__(
        self, model: Model, hover: Hover, settings: ControllerSettings, owned: Sequence[int],
        X_ref: Array | None = None, track: Track | None = None, obstacles: Sequence[Obstacle] = (),
    ) -> None:  # fmt: skip
        self.model = self._whole = model  # with motor failures reported to `fail`, and without
        self._gone = self._off = self._released = frozenset[int]()
        self.settings = settings
        self._decision = Decision(model.system, settings, owned)
        self.owned, self.own = self._decision.uavs, self._decision.own  # UAVs, and positions of their inputs in u
        self.regulation = Regulation(model, hover, settings, X_ref, track)
        self.law, self.end = self.regulation.law, self.regulation.cost_to_go
        self.cost = self.regulation.cost
        self._program = Program(self._decision, self.cost, self.regulation.user_costs)
        self._along = Along(self._decision, obstacles)
        self._relaxation = self._relaxed(others_obstruct=self._program.shares_rows)
        self._at_hover: Linearisation | None = None
        # Derivatives and difference equation of the newest step.
        self._held: tuple[Array | None, Discrete | None] = None, None
        self._curvature: Array | None = None  # outputs along a trajectory beyond their linearisation, (N_p + 1, p)

    def step(
        self, x0: Array, u0: Array, U: Array, y_ref: Array, law: FeedbackLaw | None = None,
        forces: Array | None = None, ticks_since_start: int | None = None, end: CostToGo | None = None,
    ) -> StepResult:  # fmt: skip
        """Return the plan of one step; never raises for a problem without solution.

        Args:
            x0: State at the first step of the horizon, (n,); with motor lag [x, actual inputs], (n + m,).
            u0: Inputs in force just before it, all UAVs, (m,): linearisation point and origin of the rates.
            U: Announced inputs of all UAVs, (N_p, m); the owned columns hold the previous plan, shifted.
            y_ref: Reference outputs at steps 0..N_p, (N_p + 1, p).
            law: Shared control law over the horizon, with closed-loop prediction.
            end: The cost after the horizon, with terminal "riccati".
            forces: Estimated external forces, inertial frame, N, and mass (`Model`); None without estimate.
            ticks_since_start: Since this controller began; soon after it w is larger in `conclude`.
        """
        linear = self.linearise(x0, u0, forces)
        prediction = self.predict(linear, self.discretise(linear), U, law)
        qp = self.condense(linear, prediction, y_ref, law, end)
        return self.conclude(self.solve(qp), prediction, U, law, ticks_since_start)

    def linearise(self, x0: Array, u0: Array, forces: Array | None = None) -> Linear:
        """Linearise about x0, (n,), or [x, actual inputs], (n + m,), and u0, (m,), SI: (15), (37), (40), (55)."""
        u_target = self.cost.u_target
        if forces is not None and self.settings.weights.penalised_input == "deviation":
            u_target = u_target + self.regulation.target.M_u @ self.model.at_rest(forces)
        lag_s, n, settings = self.settings.motor_lag_s, self.model.system.n, self.settings
        x, actual = x0[:n], x0[n:] if lag_s > 0.0 else u0
        if settings.linearisation == "present" or settings.prediction == "open_loop":
            model = self.model.linearise(x, actual, forces=forces)
        else:  # along the control law, with the derivatives at hover
            at_rest = self.regulation.hover
            self._at_hover = self._at_hover or self.model.linearise(at_rest.x, at_rest.u)
            f = self.model.derivative(x, actual, forces=forces)
            model = replace(self._at_hover, f=f, y=self.model.outputs(x))
        if lag_s > 0.0:
            model = lagged(model, actual, u0, lag_s, self.model.system.commands_rates)
        return Linear(x0=x, z0=x0, u0=u0, model=model, u_target=u_target, forces=forces)

    def discretise(self, linear: Linear) -> Discrete:
        """Return the difference equation over the sampling period. Source: docs/equations.md (16)-(17)."""
        model, period_s = linear.model, self.settings.sampling_period_s
        if self.settings.discretisation == "euler":
            return euler(model, period_s)
        values, known = self._held
        found = zero_order_hold(model, period_s, known if values is model.values else None)
        self._held = model.values, found
        return found

    def predict(self, linear: Linear, discrete: Discrete, U: Array, law: FeedbackLaw | None) -> Prediction | Course:
        """Predict the team; valid until the next prediction, as is its QP: equations.md (22)-(24), (35)-(36), (73)."""
        if law is not None and law.along is not None:
            return self._along.course(self.model, linear, law, law.along)
        found, self._curvature = None, None
        if law is not None and self.settings.linearisation == "along":  # (35a)
            Z, inputs = rollout(self.model, self.settings, linear.z0, law, linear.forces)
            X = Z[:, : self.model.system.n]
            view = state.StateView(X)
            angles = np.concatenate([view.Theta0[:, None, :2], view.Theta[..., :2]], axis=1)
            if np.abs(angles).max() < _STEEPEST and np.isfinite(Z).all():
                found = Z, inputs
                at = linear.model
                self._curvature = self.model.outputs_along(X) - at.y - (Z - linear.z0) @ at.C.T
        return self._program.predict(linear, discrete, U, law, found)

    def condense(
        self, linear: Linear, prediction: Prediction | Course, y_ref: Array, law: FeedbackLaw | None = None,
        end: CostToGo | None = None,
    ) -> QP:  # fmt: skip
        """Return the QP in the scaled decision and the slacks; arguments as those of `step`: (22)-(30), (48)."""
        if isinstance(prediction, Course):
            return self._along.program(self.model, prediction)
        if self._curvature is not None:
            y_ref = y_ref - self._curvature
        return self._program.condense(linear, prediction, y_ref, law, end)

    def solve(self, qp: QP) -> Solution:
        """Solve by the chosen solver, or by Clarabel when that fails."""
        return solve(qp, self.settings.solver)

    def conclude(
        self, solution: Solution, prediction: Prediction | Course, U: Array, law: FeedbackLaw | None,
        ticks_since_start: int | None = None,
    ) -> StepResult:  # fmt: skip
        """Return w U* + (1 - w) U_previous; after a failure the previous plan: (30a), (36a).

        With a shared control law only the corrections are mixed. Soon after the start of an agent w is larger.
        """
        w, decision, solved = self._relaxation, self._decision, solution.status == "solved"
        if ticks_since_start is not None:
            w = max(w, 1.0 / (ticks_since_start + 1))
        z = solution.z[: decision.size] if solved else np.zeros(decision.size)
        if isinstance(prediction, Course):
            announced = prediction.law if law is None else law
            inputs, c = self._along.planned(self.model, prediction, announced, z, w if solved else 0.0)
        elif law is None:
            inputs, c = U[:, self.own], np.zeros((0, len(self.own)))
            if solved:
                # The solver meets the bounds to its tolerance; the plant's actuators have them exactly.
                best = decision.clip(prediction.U_free + decision.inputs(z))
                inputs = decision.clip(w * best + (1.0 - w) * inputs)
        else:
            inputs, c = self._program.relaxed(prediction, law, z, w if solved else 0.0)
        if np.isfinite(inputs).all() and np.abs(c).max(initial=0.0) <= LARGEST:
            return StepResult(U=inputs, c=c, solution=solution)
        return self.give_up(U, law, solution)

    def give_up(self, U: Array, law: FeedbackLaw | None, solution: Solution | None = None) -> StepResult:
        """Return the previous plan within bounds, where numbers are out of range; no solution: so are those of a QP."""
        c = np.zeros((0, len(self.own))) if law is None else law.c[:, self.own]
        solution = solution or unsolved(0, 0, self.settings.solver)
        return StepResult(U=self._decision.clip(U[:, self.own]), c=c, solution=solution)

    def foreseen(self, prediction: Prediction | Course, inputs: Array) -> Array:
        """Return the inputs of all UAVs that this controller expects with given owned ones, within bounds, (N_p, m)."""
        U: Array = prediction.U_all.copy()
        if isinstance(prediction, Prediction):
            U += convolve(prediction.feedback, inputs - prediction.U_free)
        U[:, self.own], N = inputs, self.model.system.N
        return np.clip(U, self.settings.lower(N), self.settings.upper(N))

    def adapted(self, law: FeedbackLaw, linear: Linear, discrete: Discrete, U: Array, columns: Places) -> FeedbackLaw:
        """Return the law whose corrections, in some columns of u, reproduce U announced under another: (46)."""
        c = law.c.copy()
        if law.along is not None:
            open_loop = replace(law, K=np.zeros_like(law.K), u_rest=U, feedforward=np.zeros_like(U), c=np.zeros_like(U))
            dX = rollout(self.model, self.settings, linear.x0, open_loop, linear.forces)[0] - linear.x0
            c[:, columns] = (U - law.uncorrected - np.einsum("kmn,kn->km", law.K, dX[:-1]))[:, columns]
            return replace(law, c=c)
        dX = free_response(discrete.A, discrete.f_d + (U - linear.u0) @ discrete.B.T)
        c[:, columns] = U[:, columns] - law.uncorrected[:, columns] - dX[:-1] @ law.K[columns].T
        return replace(law, c=c)

    def without(self, uavs: Collection[int], since: int | None = None) -> None:
        """Set the UAVs without an agent, 0-based: they follow the fail-safe; `since` as in `Regulation.form`."""
        self._gone = frozenset(uavs)
        # UAVs without agents obstruct the others: several agents correct the same distances, each its share of them.
        self._relaxation = self._relaxed(others_obstruct=bool(uavs) or self._program.shares_rows)
        self._form(since)

    def _relaxed(self, *, others_obstruct: bool) -> float:
        """Return the relaxation of corrections; at most the share of the owned UAVs where all correct the same."""
        is_shared = others_obstruct and self.settings.prediction == "closed_loop"
        return min(self.settings.relaxation, len(self.owned) / self._whole.system.N if is_shared else 1.0)

    def fail(self, off: Collection[int], released: Collection[int], since: int | None = None) -> None:
        """Set the UAVs without motors, 0-based, and those of them that are released from their rods: (50), (51)."""
        self._off, self._released = frozenset(off), frozenset(released)
        self.model = Model(self._whole.system, off, released) if off else self._whole
        self._form(since)

    def _form(self, since: int | None) -> None:
        self.regulation.form(self._gone, self._off, self._released, since=since)
        self.cost, self._at_hover = self.regulation.cost, None
        self._program.form(self.cost, self._gone)
