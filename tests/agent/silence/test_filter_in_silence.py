"""The filter of an agent that hears no other: a bounded covariance, and estimates that begin anew."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from msgspec import structs

from tests.support import runs
from tests.support.runs import VEHICLE, measurement
from transport.agent.communication.announced_inputs import AnnouncedInputs
from transport.agent.communication.unannounced_inputs import Silent, Unannounced
from transport.agent.estimation.estimator import sensor_estimator
from transport.agent.estimation.filter.belief import Belief
from transport.agent.estimation.filter.filter_interface import FilterPeriod, Sensed
from transport.agent.estimation.filter.gain_reuse import GainReuse
from transport.agent.estimation.filter.team_filter import TeamFilter
from transport.agent.estimation.predicted_motion import Failure, PredictedMotion
from transport.agent.estimation.sensor_estimator import SensorEstimator
from transport.agent.silence.silence_thresholds import SHARED
from transport.model import state
from transport.model.arrays import Array, ShapeError
from transport.model.linear.linearisation import Model
from transport.model.physics.hover import motor_off_state
from transport.mpc.controller import Controller
from transport.protocol.scenario.setup.run_setup import Setup

ALL = tuple(range(5))
FORCES = "controller.disturbance.estimate=true"
# Ticks after which a covariance that has a fixed point is there: many times its slowest mode.
SETTLED, MORE = 600, 200
# Change of the largest deviation over `MORE` ticks that counts as none; a walk grows by percents.
SAME = 1e-5
# Most by which the largest deviation of a pass of `eight` exceeds that of the pass before: rounding.
LAP = 1.05


def _alone(run: Setup, along: Sequence[tuple[Array, Array]], ticks: int) -> list[float]:
    """Return the largest standard deviation of a filter that has UAV 1's measurements, by tick."""
    controller = Controller(run.model, run.hover, run.settings, run.owned[0], run.reference.sampled)
    kalman, m = TeamFilter(run.run), run.system.m
    by_law = np.repeat(np.arange(run.system.N) != 0, state.INPUTS)
    unannounced = Unannounced(by_law=by_law, by_fail_safe=np.zeros(m, dtype=bool))
    silent = Silent(alone=by_law.astype(np.float64), correlation=np.zeros(m))

    belief, deviations = kalman.first(along[0][0]), []
    for k in range(ticks):
        tick = k % len(along)
        period = FilterPeriod(
            model=run.model,
            end=along[(k + 1) % len(along)][0],
            u=along[tick][1],
            forces=kalman.forces(belief),
            unannounced=unannounced,
            K=controller.regulation.gain(tick),
            correlation=SHARED,
            silent=silent,
        )
        prior = kalman.predict(belief, period)
        z = run.model.sensed(period.end, period.u, forces=kalman.forces(prior))[: state.SENSED]
        belief = kalman.correct(prior, run.model, [Sensed(uav=0, sensors=ALL, values=z)])
        belief = replace(belief, x=period.end)
        deviations.append(math.sqrt(belief.covariance.P.diagonal().max()))
    return deviations


@pytest.mark.parametrize(
    ("name", "settings"),
    [("eight", ()), ("eight", (FORCES,)), ("gap", ()), ("precise", VEHICLE), ("precise", (*VEHICLE, FORCES)),
     ("windy", VEHICLE)],
)  # fmt: skip
def test_in_silence_the_covariance_has_a_fixed_point(name: str, settings: Sequence[str]) -> None:
    """At hover, with own measurements alone, every standard deviation settles: (63), (63c), (63d)."""
    run = runs.ready(name, *settings)
    deviations = _alone(run, [(run.initial_state(), run.hover.u)], SETTLED + MORE)
    assert abs(deviations[-1] / deviations[SETTLED] - 1.0) < SAME
    assert deviations[-1] <= deviations[0]


def test_in_silence_the_covariance_along_a_path_is_bounded() -> None:
    """Along `eight` the largest deviation of a third pass is that of the second, (63c)."""
    run = runs.ready("eight")
    track = run.reference.sampled.track
    assert track is not None
    along = list(zip(track.X[: run.ticks], track.U[: run.ticks], strict=True))
    deviations = _alone(run, along, 3 * run.ticks)
    second, third = deviations[run.ticks : 2 * run.ticks], deviations[2 * run.ticks :]
    assert max(third) <= LAP * max(second)


def _estimator(run: Setup) -> tuple[SensorEstimator, AnnouncedInputs]:
    """Return the estimator of agent 1 about the reference, without a shared law."""
    no_gain = np.zeros((run.system.m, run.system.n))
    estimator = sensor_estimator(run.run, 1, lambda tick: run.X_ref[tick], lambda _: no_gain)
    return estimator, AnnouncedInputs(run.owned, run.hover.u, own=1)


def test_an_estimate_out_of_range_begins_anew() -> None:
    """A belief far over is replaced by one about the reference, and counted."""
    run = runs.setup(*VEHICLE)
    estimator, announced = _estimator(run)
    wrong = np.zeros(state.SENSED)
    wrong[state.THETA] = [1.56, 0.0, 0.0]
    for k in range(4):
        seen = measurement(run, 1, k)
        z = run.model.sensed(run.X_ref[k], run.hover.u)[: state.SENSED]
        if k == 0:
            z = z + wrong
        seen = structs.replace(seen, payload=np.zeros(0), uav_states=z[None])
        estimator.measure(seen)
        x = estimator.estimate(k, announced)
        assert np.isfinite(x).all()
        assert np.abs(state.StateView(x).Theta[:, :2]).max() < 1.5
    assert estimator.resets == {0}


def test_an_estimate_that_measurements_deny_begins_anew() -> None:
    """A belief within centimetres and a UAV that measures itself a metre away: one of them is wrong."""
    run = runs.setup(*VEHICLE)
    estimator, announced = _estimator(run)
    away = np.zeros(state.SENSED)
    for k in range(11):
        if k == 9:  # a tick with a gain of its own
            away[state.POSITION] = [1.0, 0.0, 0.0]
        z = run.model.sensed(run.X_ref[k], run.hover.u)[: state.SENSED] + away
        seen = measurement(run, 1, k)
        estimator.measure(structs.replace(seen, payload=np.zeros(0), uav_states=z[None]))
        estimator.estimate(k, announced)
    assert estimator.resets
    assert min(estimator.resets) == 9


class Singular(GainReuse):
    """A filter whose covariance cannot be computed when a failure sets entries of the state."""

    def certain(self, belief: Belief, entries: npt.NDArray[np.intp]) -> Belief:
        """Raise, as the zero-order hold does far out of range."""
        raise ShapeError(f"{len(entries)} entries of {len(belief.x)}: out of range")


def test_a_covariance_out_of_range_at_a_failure_begins_anew() -> None:
    """The filter raises at the tick at which motors stop; the agent goes on, and counts it."""
    run = runs.setup(*VEHICLE)
    no_gain = np.zeros((run.system.m, run.system.n))
    motion = PredictedMotion(
        model=run.model,
        reference=lambda tick: run.X_ref[tick],
        period_s=run.settings.sampling_period_s,
    )
    team_filter = Singular(TeamFilter(run.run), run.owned[0])
    estimator = SensorEstimator(motion, run.owned[0], team_filter, lambda _: no_gain, (0,) * 5)
    announced = AnnouncedInputs(run.owned, run.hover.u, own=1)
    for k in range(4):
        if k == 2:
            stopped = Model(run.system, off=[3])
            estimator.change(
                Failure(
                    tick=2,
                    model=stopped,
                    hover=run.hover,
                    moved=lambda x: motor_off_state(x, 3),
                    own_left=run.owned[0],
                )
            )
        x = estimator.estimate(k, announced)
        assert np.isfinite(x).all()
    assert estimator.resets == {2}
