"""The shared control law of a team along a reference, as a value."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from transport.model.arrays import Array, rows
from transport.model.path.flat_reference import Track
from transport.model.physics.hover import Hover
from transport.mpc.alone.fail_safe import FailSafe
from transport.mpc.law.hover_law import HoverLaw
from transport.mpc.law.infinite_horizon_lqr import Regulator, TeamFailures
from transport.mpc.law.preview import Preview
from transport.mpc.law.steady_state import SteadyState
from transport.mpc.law.tracking_lqr import Tracker
from transport.mpc.program.feedback_law import FeedbackError, FeedbackLaw, Gains
from transport.mpc.program.horizon_and_terminal_cost import CostToGo
from transport.mpc.program.stage_cost import Cost


@dataclass(frozen=True, kw_only=True, eq=False)
class TeamLaw:
    """The control law u = u_rest + K (x - x_ref) + feedforward + c of a team along a reference."""

    about_hover: HoverLaw
    fail_safe: FailSafe  # of the UAVs without plans
    preview: Preview | None = None  # response to a hover reference ahead
    tracker: Tracker | None = None  # regulator along a flat reference

    @property
    def track(self) -> Track | None:
        """The flat reference of this team."""
        return self.fail_safe.track

    @property
    def team(self) -> TeamFailures:
        """The team that the law is for: fewer failures than asked for if these leave no law."""
        return self.about_hover.hovering.team

    @property
    def hover(self) -> Hover:
        """The equilibrium of the team."""
        return self.about_hover.hovering.hover

    @property
    def cost(self) -> Cost:
        """The cost of the team."""
        return self.about_hover.hovering.cost

    @property
    def regulator(self) -> Regulator | None:
        """The regulator about hover; None if the settings need none."""
        return self.about_hover.regulator

    @property
    def _closing(self) -> Regulator | None:
        """The regulator about hover, where it closes the loop of the prediction."""
        is_closed = self.about_hover.crew.settings.prediction == "closed_loop"
        return self.about_hover.regulator if is_closed else None

    @property
    def target(self) -> SteadyState:
        """The steady state under external forces."""
        return self.about_hover.target

    @property
    def gain_source(self) -> Regulator | Tracker | None:
        """The part that has the gains: the same object (`is`) as long as these are the same.

        The feedforward may change with a target all the same.
        """
        return self.about_hover.regulator if self.tracker is None else self.tracker

    def over(
        self, x0: Array, x_ref: Array, c: Array, forces: Array | None = None, start: int = 0
    ) -> FeedbackLaw | None:
        """Return the law over a horizon; None with open-loop prediction.

        Args:
            x0: State at instant `start`, (n,), or with motor lag (n + m,).
            x_ref: Reference states, (N_p, n); along a flat reference only their number counts, as
                the law has states of its own there.
            c: Corrections, (N_p, m).
            forces: External forces, (3 + 3 N,), N, perhaps followed by the payload's mass error, kg.
            start: Instant of the reference.

        Source: docs/equations.md (35), (40), (73).
        """
        regulator = self._closing
        if regulator is None:
            return None
        if self.tracker is not None and self.track is not None:
            gains = self.tracker.over(start, len(x_ref))
            return self._along(self.track, gains, x0, c, forces, start)
        return self._about_hover(regulator, x0, x_ref, c, forces, start)

    def _about_hover(
        self,
        regulator: Regulator,
        x0: Array,
        x_ref: Array,
        c: Array,
        forces: Array | None,
        start: int,
    ) -> FeedbackLaw:
        """Return the law u = u_hover + M_u F + K (x - x_ref - M_x F) + c_ff, (35), (40)."""
        law = self.about_hover
        u_rest = self.hover.u
        error = self._error(x0, x_ref)
        feedforward = self.feedforward(start, len(x_ref))
        if forces is not None:
            forces = law.hovering.model.with_weight_of_mass_error(forces)
            u_rest = u_rest + law.target.M_u @ forces
            error = error - self._shift(forces)
            feedforward = feedforward + law.forced[0] @ forces
        return FeedbackLaw(K=regulator.K, u_rest=u_rest, error=error, feedforward=feedforward, c=c)

    def _along(
        self,
        track: Track,
        gains: Sequence[Gains],
        x0: Array,
        c: Array,
        forces: Array | None,
        start: int,
    ) -> FeedbackLaw:
        """Return the law along a flat reference, shifted by its derivatives by the forces, (73)."""
        where = rows(start - track.first, len(gains), len(track.X))
        u_rest = track.U[where]
        error = x0 - track.X[where]
        if forces is not None:
            # The forces may lack the mass error, the last of the derivatives.
            X_forces, U_forces = track.by_forces(where)
            u_rest = u_rest + U_forces[..., : len(forces)] @ forces
            error = error - X_forces[..., : len(forces)] @ forces
        return FeedbackLaw(
            K=np.array([at.K for at in gains]),
            u_rest=u_rest,
            error=error,
            feedforward=np.array([at.feedforward for at in gains]),
            c=c,
            gains=gains,
        )

    def inputs(self, x: Array, x_ref: Array, forces: Array | None, instant: int) -> Array | None:
        """Return the inputs at one instant without corrections, (m,); None in open loop.

        Those about hover without forces, which are asked for most, need no `FeedbackLaw`.
        """
        regulator = self._closing
        if regulator is None or self.tracker is not None or forces is not None:
            law = self.over(x, x_ref[None], np.zeros((1, 0)), forces, instant)
            return None if law is None else law.uncorrected[0]
        # With constant gains, (35): u_hover + K (x - x_ref) + c_ff.
        fed_back = regulator.K @ self._error(x, x_ref)
        return np.asarray(self.hover.u + fed_back + self.feedforward(instant, 1)[0])

    def gain(self, instant: int) -> Array:
        """Return the feedback gain K, (m, n), with motor lag (m, n + m), where there is a regulator.

        In closed loop it is the derivative of `inputs` by the state. A law with a track has a tracker
        once its gains are computed; until then these are the gains about hover.
        Raises: FeedbackError: there is no regulator.
        """
        if self.tracker is not None:
            return self.tracker.over(instant, 1)[0].K
        if self.about_hover.regulator is None:
            raise FeedbackError("expected a shared control law, got open-loop prediction")
        return self.about_hover.regulator.K

    def cost_to_go(
        self, x0: Array, x_ref: Array, forces: Array | None = None, instant: int = 0
    ) -> CostToGo | None:
        """Return the cost after the horizon; reference, (n,), and instant are those of step N_p.

        Source: docs/equations.md (36d).
        """
        law = self.about_hover
        is_riccati = law.crew.settings.terminal == "riccati"
        if law.regulator is None or not is_riccati or self.track is not None:
            return None

        error = self._error(x0, x_ref)
        slope = np.zeros_like(x0)
        if self.preview is not None:
            known = len(self.preview.slope)
            slope = self.preview.slope[rows(instant - self.preview.first, 1, known)][0]
        if forces is not None:
            forces = law.hovering.model.with_weight_of_mass_error(forces)
            error = error - self._shift(forces)
            slope = slope + law.forced[1] @ forces
        return CostToGo(root=law.regulator.root, error=error, slope=slope)

    def feedforward(self, start: int, steps: int) -> Array:
        """Return the response to the reference ahead from instant `start` on, (steps, m).

        Zero without preview. Source: docs/equations.md (36c).
        """
        if self.preview is None:
            return np.zeros((steps, self.about_hover.hovering.model.system.m))
        known = len(self.preview.slope)
        return self.preview.feedforward[rows(start - self.preview.first, steps, known)]

    def _error(self, x0: Array, x_ref: Array) -> Array:
        """Return the deviation of a state from reference states, (..., n).

        With motor lag the actual inputs deviate from hover.
        """
        if len(x0) > x_ref.shape[-1]:
            u_hover = self.hover.u
            actual = np.broadcast_to(u_hover, (*x_ref.shape[:-1], len(u_hover)))
            x_ref = np.concatenate([x_ref, actual], axis=-1)
        return x0 - x_ref

    def _shift(self, forces_at_rest: Array) -> Array:
        """Return the deviation of the target from hover under forces, (n,).

        With motor lag (n + m,): at rest the actual inputs are the command.
        """
        target = self.about_hover.target
        shift: Array = target.M_x @ forces_at_rest
        if not self.about_hover.crew.settings.motor_lag_s:
            return shift
        return np.concatenate([shift, target.M_u @ forces_at_rest])
