"""Estimator of an agent: what both kinds have in common, and the choice between them."""

from collections.abc import Callable, Mapping
from typing import Protocol

from transport.agent.communication.announced_inputs import AnnouncedInputs
from transport.agent.estimation.disturbance import DisturbanceEstimator, MeasuredTeam
from transport.agent.estimation.filter.belief import Belief
from transport.agent.estimation.filter.gain_reuse import MOST_TICKS, GainReuse
from transport.agent.estimation.filter.team_filter import TeamFilter
from transport.agent.estimation.predicted_motion import STEPS, Failure, PredictedMotion
from transport.agent.estimation.received_states import NewStates
from transport.agent.estimation.sensor_estimator import Feedback, SensorEstimator
from transport.agent.estimation.state_estimator import StateEstimator
from transport.model.arrays import Array
from transport.protocol.scenario.setup.team_run import TeamRun
from transport.protocol.wire.messages import Measurement, Plan


class Estimator(Protocol):
    """Estimate of the whole state from messages, in any order of arrival."""

    @property
    def new_states(self) -> NewStates:
        """Newest ticks that were heard of."""

    @property
    def forces(self) -> Array | None:
        """Estimated external forces, as `Model` takes them, N; None if not estimated."""

    @property
    def belief(self) -> Belief | None:
        """Newest estimate with its covariance; None without one."""

    @property
    def resets(self) -> set[int]:
        """Ticks at which the estimate began anew, as numbers were out of range."""

    def take(self, plan: Plan) -> None:
        """Take in another agent's plan, of a tick before the next measurement's."""

    def measure(self, measurement: Measurement) -> None:
        """Take in a measurement of a tick not later than the one to be estimated."""

    def change(self, failure: Failure) -> None:
        """Change the system at a tick, not before the previous change."""

    def estimate(self, k: int, announced: AnnouncedInputs) -> Array:
        """Return the estimate at tick k, read-only, with all that is known now."""

    def past(self, tick: int) -> Array | None:
        """Return the estimate at a past tick, read-only; None where it is not kept."""

    def start_state(self, tick: int) -> Array | None:
        """Return the estimate at the start of a plan, to compare its first step with the law.

        None where it is not kept, or where that difference would be noise.
        """

    def inputs_until(self, k: int, announced: AnnouncedInputs) -> Array:
        """Return the inputs in force until tick k, after `estimate` for it, (4 N,)."""

    def reported(self, k: int, x: Array) -> Array:
        """Return the rows of the own UAVs for the plan of tick k, estimated as x."""

    def log_numbers(self) -> Mapping[str, float]:
        """Return numbers for the log by name."""


def estimator_of(
    setup: TeamRun, agent: int, reference: Callable[[int], Array], feedback: Feedback
) -> Estimator:
    """Return the estimator of an agent, 1-based, by `controller.estimator`.

    Given are the state to assume at a tick, (n,), with motor lag (n + m,), and the gain by which
    the other agents answer to their estimates.
    """
    if setup.settings.estimator == "kalman":
        return sensor_estimator(setup, agent, reference, feedback)
    return state_estimator(setup, agent, reference)


def state_estimator(
    setup: TeamRun, agent: int, reference: Callable[[int], Array]
) -> StateEstimator:
    """Return the estimator from measured states, with forces if the scenario has them estimated."""
    owned = setup.owned[agent - 1]
    section = setup.settings.disturbance
    disturbance = None
    if section.estimate:
        team = MeasuredTeam(model=setup.model, hover=setup.hover, owned=owned)
        period_s = setup.settings.sampling_period_s
        disturbance = DisturbanceEstimator(team, period_s, section.time_constant_s)
    return StateEstimator(_motion(setup, reference, STEPS), owned, disturbance)


def sensor_estimator(
    setup: TeamRun,
    agent: int,
    reference: Callable[[int], Array],
    feedback: Feedback,
    most_ticks: int = MOST_TICKS,
) -> SensorEstimator:
    """Return the estimator from the vehicles' sensors, with ticks at which a gain is used again."""
    owned = setup.owned[agent - 1]

    # Unknown forces change within few ticks, and with them the gain. An agent that owns all UAVs
    # has no ticks with a part of the measurements.
    is_reusing = len(owned) < setup.system.N and not setup.settings.disturbance.estimate
    team_filter = GainReuse(TeamFilter(setup), owned, most_ticks if is_reusing else 0)

    # One integration step errs far less than the filter does.
    motion = _motion(setup, reference, steps=1)
    return SensorEstimator(motion, owned, team_filter, feedback, setup.sensors.ages)


def _motion(setup: TeamRun, reference: Callable[[int], Array], steps: int) -> PredictedMotion:
    """Return the motion of the team by the agents' model."""
    return PredictedMotion(
        model=setup.model,
        reference=reference,
        period_s=setup.settings.sampling_period_s,
        steps=steps,
        lag_s=setup.settings.motor_lag_s,
    )
