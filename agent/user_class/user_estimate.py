"""The project's estimate of the team for a class of the user that is a controller only."""

import numpy as np

from transport.agent.estimation.predicted_motion import STEPS
from transport.agent.estimation.team_estimate import TeamEstimate
from transport.agent.received import Received
from transport.model.arrays import Array
from transport.model.linear import motor_lag as motors
from transport.mpc.controller import Controller
from transport.protocol.scenario.setup.team_run import TeamRun
from transport.protocol.wire.messages import Plan


class OwnEstimate:
    """State of the team as an agent, 1-based, can know it; renewed before each step of its class.

    With measured states it is the model's prediction, corrected at each tick by the states that
    belong to it. With `plant.sensors = "vehicle"` it is the error-state Kalman filter of
    docs/equations.md (63)-(64). The other agents are assumed to apply their plans row by row.

    Attributes:
        x: State at the present tick, (12 + 12 N,), read-only.
        x_start: State at the first tick that the plan acts at, (12 + 12 N,).
        u_before: Inputs in force just before that tick, (4 N,).
    """

    def __init__(self, setup: TeamRun, agent: int) -> None:
        self._setup = setup
        self._n = setup.system.n
        self._controller = Controller(
            setup.model,
            setup.hover,
            setup.settings,
            setup.owned[agent - 1],
            setup.reference.sampled,
            setup.obstacles,
        )
        self._team = TeamEstimate(setup, agent, self._controller, has_shared_law=False)
        self._tick = 0
        self._start = 0

        x = setup.initial_state()
        self.x = x
        self.x_start = x
        self.u_before: Array = setup.hover.u.copy()

    @property
    def covariance(self) -> Array | None:
        """Covariance of the error of `x`, (n, n); None with measured states.

        It is singular along the length of the rods, which is certain: T P T' with the basis T of
        the manifold of states.
        """
        belief = self._team.estimator.belief
        if belief is None:
            return None
        covariance = belief.covariance
        T = covariance.basis.T[: self._n]
        P = covariance.P[: T.shape[1], : T.shape[1]]
        return np.asarray(T @ P @ T.T)

    @property
    def forces(self) -> Array | None:
        """External forces as `run.model` takes them, N; None without an estimate.

        They are estimated with `controller.disturbance.estimate`.
        """
        return self._team.forces

    def announced(self, steps: int) -> Array:
        """Return the inputs of all UAVs over some steps from `x_start` on, (steps, 4 N).

        They are those of the newest plans, aligned by `controller.received_plans`, the last row
        held; hover before the first plan.
        """
        return self._team.announced.sequence(self._start, steps, before=self._tick)

    def follow(self, setup: TeamRun) -> None:
        """Take the reference from a run with a further target."""
        self._setup = setup
        self._team.follow(setup)

    def update(self, received: Received) -> None:
        """Take in what has arrived at a tick."""
        team = self._team
        k = received.tick
        x = team.update(received)
        self._tick = k
        self.x = x[: self._n]
        if not self._setup.rules.clock.next_tick:
            self._start = k
            self.x_start = self.x
            self.u_before = team.estimator.inputs_until(k, team.announced)
            return

        self._start = k + 1
        self.u_before = team.announced.in_force(k, before=k, x=x)
        settings = self._setup.settings
        period = motors.Period(
            duration_s=settings.sampling_period_s, steps=STEPS, lag_s=settings.motor_lag_s
        )
        x_end = motors.integrate(
            self._controller.model,
            x,
            self.u_before,
            period,
            team.forces,
        )
        self.x_start = x_end[: self._n]

    def announce(self, plan: Plan) -> None:
        """Take in the own plan of the present tick."""
        self._team.announced.add(plan)
