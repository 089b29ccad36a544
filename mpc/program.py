"""The QP of one step in the scaled decision and the slacks, by the compiled kernels, or by products of matrices."""

import ctypes
from collections.abc import Collection
from dataclasses import replace

import numpy as np

from model import native
from model.arrays import Array, padded
from model.discretisation import Discrete
from model.state import input_indices
from mpc.cost import Cost
from mpc.expressions import UserCosts
from mpc.feedback import FeedbackLaw
from mpc.prediction import Linear, Prediction, convolve, follow, predict, stacked
from mpc.qp import QP
from mpc.regulation import CostToGo
from mpc.rows import Decision, Rows

_NONE, _NO_GAIN = np.zeros(0, dtype=np.intp), np.zeros((0, 0))


class Program:
    """Prediction and QP of one controller; with compiled kernels their arrays hold until the next prediction."""

    def __init__(self, decision: Decision, cost: Cost, user_costs: UserCosts) -> None:
        self.decision, self._user_costs, self._rows = decision, user_costs, Rows(decision)
        self.shares_rows = self._rows.are_shared  # whether several agents keep the same rows of inputs
        settings, system = decision.settings, decision.system
        self._n = system.n + (system.m if settings.motor_lag_s > 0.0 else 0)
        # Outputs without a weight stay out of the program.
        self._weighted = np.flatnonzero(cost.Q)
        self._effort = cost.R[decision.own] * decision.scale
        self._no_terms = np.zeros(0), np.zeros((0, self._n))
        self._predicted: Prediction | None = None  # the newest one by the kernels, and its control law
        self._law: FeedbackLaw | None = None
        self._addresses: dict[str, tuple[np.ndarray, int]] = {}
        self._renewed: set[str] = set()  # arrays that are others than in the QP before
        self._fed_back: Array | None = None  # state matrix of the prediction before, if it was along a trajectory
        if native.AVAILABLE:
            self._allocate()
        self.form(cost, ())

    def form(self, cost: Cost, uncontrolled: Collection[int]) -> None:
        """Set the team: its weights, and its UAVs without an agent, 0-based."""
        self._responding = np.setdiff1d(self.decision.others, input_indices(sorted(uncontrolled)))
        self._Q = np.concatenate([cost.Q[self._weighted], self._user_costs.weights])
        # With the inputs of the other agents' UAVs as further outputs.
        self._Q_with_others = np.concatenate([self._Q, cost.R[self._responding]])

    def predict(
        self, linear: Linear, discrete: Discrete, U: Array, law: FeedbackLaw | None,
        along: tuple[Array, Array] | None = None,
    ) -> Prediction:  # fmt: skip
        """Predict the team, as in `Controller.step`; exactly along states and inputs of the law, if they are given."""
        own, u0, is_new = self.decision.own, linear.u0, True
        if native.AVAILABLE:
            at, kept, problem = native.at, self._kept, self._problem
            problem.A, problem.B, problem.f_d = kept("A", discrete.A), kept("B", discrete.B), at(discrete.f_d)
            problem.u0, problem.K = at(u0), kept("K", _NO_GAIN if law is None else law.K)
            problem.uncorrected, problem.announced = (0, at(U)) if law is None else (at(law.uncorrected), at(law.c))
            is_new = not self._renewed.isdisjoint(("A", "B", "K"))
            if along is None or is_new:
                native.KERNELS.respond(ctypes.addressof(problem))
            found = self._predicted = self._open if law is None else self._closed
            self._law = law
        else:
            found = predict(discrete, u0, own, U, law)
        if law is None or along is None:
            self._fed_back = None
        else:
            if self._fed_back is None or is_new:
                B_others = discrete.B.copy()
                B_others[:, own] = 0.0
                self._fed_back = discrete.A + B_others @ law.K
            follow(found, self._fed_back, discrete.B, u0, own, law, *along)
        return found

    def condense(
        self, linear: Linear, prediction: Prediction, y_ref: Array, law: FeedbackLaw | None, end: CostToGo | None
    ) -> QP:
        """Return the QP of a prediction: equations.md (26)-(30), (36e), (48); paper (25)-(27)."""
        terminal, responding, Q = self.decision.settings.weights.terminal, _NONE, self._Q
        if end is not None:
            terminal = 0.0  # the stage cost of the last state is part of the cost-to-go
            if law is not None:
                responding, Q = self._responding, self._Q_with_others
        at_x0, slope = self._user_costs.at(linear.x0) if len(self._user_costs) else self._no_terms
        slope = np.ascontiguousarray(padded(slope, self._n))
        if prediction is not self._predicted:
            return self._plain(linear, prediction, y_ref, slope, at_x0, end, terminal, responding, Q)
        at, kept, problem, model = native.at, self._kept, self._problem, linear.model
        problem.terminal, problem.inputs, problem.rank = terminal, len(responding), 0
        problem.answering, problem.Q = kept("answering", responding), kept("Q", Q)
        known = self._addresses.get("slope")
        slope = known[0] if known is not None and np.array_equal(known[0], slope) else slope  # those of linear terms
        problem.slope, problem.at_x0, problem.x0 = kept("slope", slope), at(at_x0), at(linear.x0)
        if end is not None:
            problem.rank, problem.error, problem.end_slope = len(end.root), at(end.error), at(end.slope)
        problem.root = kept("root", _NO_GAIN if end is None else end.root)
        begin, problem.index = model.pattern.addresses
        problem.begin, problem.value = begin + 8 * model.pattern.first_rows[-2], kept("value", model.values)
        problem.model_outputs, problem.y, problem.y_ref = len(model.y), at(model.y), at(y_ref)
        # Without a law the matrices are of the tick's own state: kept ones only meet again within its iterations.
        problem.u_target, problem.known = at(linear.u_target), not self._renewed and law is not None
        native.KERNELS.fill(ctypes.addressof(problem))
        self._renewed.clear()
        qp = self._qp
        self._rows.fill_user(linear, prediction, qp.A, qp.row_lower, qp.row_upper)
        return qp

    def _kept(self, name: str, array: np.ndarray) -> int:
        """Return the address of an array that is mostly that of the step before, and note whether it is."""
        known = self._addresses.get(name)
        if known is None or known[0] is not array:
            known = self._addresses[name] = array, native.at(array)
            self._renewed.add(name)
        return known[1]

    def relaxed(self, prediction: Prediction, law: FeedbackLaw, z: Array, w: float) -> tuple[Array, Array]:
        """Return inputs and corrections by the scaled decision and the weight of new corrections, 0 if unsolved."""
        own, decision, U_free = self.decision.own, self.decision, prediction.U_free
        if prediction is self._predicted and law is self._law:
            U, c = np.empty(decision.shape), np.empty(decision.shape)
            native.KERNELS.conclude(ctypes.addressof(self._problem), native.at(z), w, native.at(U), native.at(c))
            return U, c
        at_x0, fed_back, c = law.uncorrected[:, own], prediction.dU_free[:, own], law.c[:, own]
        best = decision.clip(U_free + decision.inputs(z))
        if w > 0.0:
            c_best = best - at_x0 - fed_back - convolve(prediction.feedback[own], best - U_free)
            if w == 1.0:
                return best, c_best
            c = w * c_best + (1.0 - w) * c
        wanted, U, before = at_x0 + c + fed_back, U_free.copy(), U_free[0]
        for k in range(len(U)):
            # Of the decisions before step k. The corrections may come from a plan of another team: the rates hold.
            answer = convolve(prediction.feedback[own, : k + 1], (U - U_free)[: k + 1])[-1]
            U[k] = before = decision.clip(np.clip(wanted[k] + answer, before - decision.rate, before + decision.rate))
        return U, c

    def _plain(
        self, linear: Linear, prediction: Prediction, y_ref: Array, slope: Array, at_x0: Array, end: CostToGo | None,
        terminal: float, responding: native.Places, Q: Array,
    ) -> QP:  # fmt: skip
        decision, chosen, (n, steps, _) = self.decision, self._weighted, prediction.effect.shape
        model, scale, dX, effect = linear.model, decision.scale, prediction.dX_free, prediction.effect * decision.scale
        C = model.C[chosen]
        free = model.y[chosen] + dX[1:] @ C.T
        effort = prediction.U_all - linear.u_target
        others = np.vstack([effort[1:, responding], np.zeros(len(responding))])  # step N_p has no input
        error = np.hstack([free - y_ref[1:, chosen], at_x0 + dX[1:] @ slope.T, others])
        S = np.concatenate([np.tensordot(np.vstack([C, slope]), effect, 1), prediction.feedback[responding] * scale])
        weights = 2.0 * np.tile(Q, (steps, 1))
        weights[-1] *= terminal
        G = stacked(S)
        H = G.T @ (weights.reshape(-1, 1) * G) + np.diag(np.tile(2.0 * self._effort * scale, steps))
        g = G.T @ (weights * error).reshape(-1) + (2.0 * self._effort * effort[:, decision.own]).reshape(-1)
        if end is not None:
            last = effect[:, ::-1].reshape(n, -1)  # effect of all decisions on the last state, the first one's first
            H += 2.0 * last.T @ end.root.T @ end.root @ last
            g += 2.0 * (end.root.T @ (end.root @ (end.error + dX[-1])) + end.slope) @ last
        penalties = self._rows.penalties
        whole = np.diag(np.concatenate([np.zeros(len(g)), penalties]))
        whole[: len(g), : len(g)] = (H + H.T) / 2.0
        lower, upper = decision.bounds(prediction.U_free, linear.u0)
        A, row_lower, row_upper = self._rows.fill(linear, prediction, free, S)
        return QP(
            H=whole, g=np.concatenate([g, penalties]), lower=np.concatenate([lower, 0.0 * penalties]),
            upper=np.concatenate([upper, np.full(len(penalties), np.inf)]),
            A=A, row_lower=row_lower, row_upper=row_upper,
        )  # fmt: skip

    def _allocate(self) -> None:
        """Make the arrays of the compiled kernels: the constant ones, and room for all results."""
        decision, rows, n, m_all = self.decision, self._rows, self._n, self.decision.system.m
        (steps, m), slacks, terms, empty = decision.shape, len(rows.penalties), len(self._user_costs), np.empty
        size, weighted, pairs, angles = decision.size + slacks, len(self._weighted), len(rows.pairs), len(rows.angles)
        effect, feedback, S = (empty((count, steps, m)) for count in (n, m_all, weighted + terms + m_all))
        dX, dU, U, U_free = empty((steps + 1, n)), empty((steps, m_all)), empty((steps, m_all)), empty((steps, m))
        H, g, lower, upper = empty((size, size)), empty(size), np.zeros(size), np.full(size, np.inf)
        A, row_lower, row_upper = rows.A.copy(), rows.lower.copy(), rows.upper.copy()
        self._arrays: dict[str, np.ndarray] = {
            "chosen": self._weighted, "own": decision.own, "pair": rows.pairs, "angle": rows.angles,
            "scale": decision.scale, "effort": self._effort, "penalties": rows.penalties,
            "low": decision.lower, "high": decision.upper, "rate": decision.rate,
            "effect": effect, "feedback": feedback, "S": S, "dX": dX, "dU": dU, "U": U, "U_free": U_free,
            "H": H, "g": g, "lower": lower, "upper": upper, "rows": A, "row_lower": row_lower, "row_upper": row_upper,
            "kept": empty((2 * n + len(S)) * (decision.size + 7) + 8),
            "free": empty((steps, weighted)), "signals": empty(steps * (m * max(pairs, angles) + pairs)),
        }  # fmt: skip
        sizes = {"steps": steps, "n": n, "m": m, "size": size, "outputs": weighted, "terms": terms, "all_inputs": m_all}
        limits = {"pairs": pairs, "angles": angles, "separation": rows.minimum_m, "tilt": rows.limit}
        addresses = {name: native.at(array) for name, array in self._arrays.items()}
        needed = native.KERNELS.predict_work(n, m_all, m), native.KERNELS.condense_work(steps, n, m, len(S), n)
        self._problem = native.Problem(**sizes, **limits, **addresses, work=native.work("step", max(needed)))
        self._qp = QP(H=H, g=g, lower=lower, upper=upper, A=A, row_lower=row_lower, row_upper=row_upper)
        self._closed = Prediction(effect=effect, dX_free=dX, U_free=U_free, U_all=U, feedback=feedback, dU_free=dU)
        self._open = replace(self._closed, feedback=feedback[:0], dU_free=dU[:, :0])
