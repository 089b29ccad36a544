"""State and inputs of the whole team as one agent estimates them, through changes of the roster and failures."""

from collections.abc import Sequence, Set
from dataclasses import dataclass

import numpy as np

from agent.announced import AnnouncedInputs
from agent.estimator import WINDOW, DisturbanceEstimator, StateEstimator
from agent.handover import News, Silence
from agent.kalman import KalmanFilter
from model import state
from model.arrays import Array
from model.hover import motor_off_state, released_state
from mpc.alone import AloneLaw, Course
from mpc.alone_team import AloneTeam
from mpc.controller import Controller
from mpc.prediction import Prediction
from mpc.tracking import Course as Along
from protocol.scenario.setup import Setup
from protocol.wire.messages import Measurement, Plan


@dataclass(frozen=True, slots=True, kw_only=True)
class Known:
    """Information of an agent at a tick."""

    measurement: Measurement  # the tick's own
    measurements: Sequence[Measurement]  # those that have become usable since the last step, in order
    plans: Sequence[Plan]  # plans of the others that have become usable since the last step, in order
    lost: int  # plans known since then to be lost on their links
    agents: Set[int]  # on the roster, 1-based
    off: frozenset[int]  # UAVs whose motors are off, 0-based
    released: frozenset[int]  # those of them that are released
    failed_since: int  # tick of the newest failure of a UAV
    ticks_since_start: int  # since this process joined
    started_ns: int  # begin of the step on the stopwatch


class TeamEstimate:
    """Estimate of one agent; the controller is kept up to date with the team.

    Attributes:
        announced: Inputs announced by all agents.
        estimator: Estimated states, by tick.
        expected: Start, prediction and own inputs of the last step, for the inputs of an agent that leaves.
    """

    def __init__(self, setup: Setup, agent: int, controller: Controller) -> None:
        self._setup, self._agent, self._controller = setup, agent, controller
        self._owned = setup.owned[agent - 1]
        self.peers = tuple(other for other in setup.agents if other != agent)
        self._off_roster: set[int] = set()  # agents that the controller leaves out
        self.restart()

    def restart(self) -> None:
        """Reset for a new start in the run; the controller keeps its state, also the agents that it leaves out."""
        setup, section = self._setup, self._setup.scenario.controller
        period_s, is_kalman = setup.settings.sampling_period_s, section.estimator == "kalman"
        self._disturbance: DisturbanceEstimator | None = None
        if section.disturbance.estimate and not is_kalman:
            self._disturbance = DisturbanceEstimator(
                setup.model, setup.hover, self._owned, period_s, section.disturbance.time_constant_s
            )
        self._filtered: Array | None = None  # forces that the Kalman filter has estimated by the last tick
        self._kalman = KalmanFilter(setup, self._controller.regulation.gain, self._owned) if is_kalman else None
        self.estimator = StateEstimator(
            setup.model, self._reference, period_s, self._disturbance, setup.settings.motor_lag_s, self._kalman
        )
        self.announced = AnnouncedInputs(
            setup.owned,
            setup.hover.u,
            section.received_plans,
            own=self._agent,
            law=self._law_inputs,
            past=None if is_kalman else self.estimator.known,
            settings=setup.settings,
        )
        self.announced.fail_safe = setup.fail_safe
        self._begin_silence(is_kalman=is_kalman)
        self._failed: tuple[frozenset[int], frozenset[int]] = frozenset(), frozenset()  # UAVs off, and released
        self.expected: tuple[int, Prediction | Along, Array] | None = None
        # Arguments and result of `_law_inputs` by tick.
        self._law_cache: dict[int, tuple[tuple[object, ...], Array | None]] = {}

    def head(self, setup: Setup) -> None:
        """Take the reference from a run with a further target."""
        self._setup = setup
        self._alone.follow(setup.X_ref, setup.track)
        if setup.ahead is not None and self._controller.regulation.head(setup.X_ref, setup.ahead):
            self.announced.law_since = setup.ahead.first
        self.announced.fail_safe = self._controller.regulation.fail_safe

    def _begin_silence(self, *, is_kalman: bool) -> None:
        """Set how the others are assumed to act when their news are overdue."""
        setup, section, announced = self._setup, self._setup.scenario.controller, self.announced
        period_s = setup.settings.sampling_period_s
        self._alone = AloneTeam(setup.model, setup.hover, setup.settings, self._controller.regulation)
        self._alone.follow(setup.X_ref, setup.track)
        self._began = False
        if section.silence == "alone" and section.prediction == "closed_loop":
            heartbeat_s = section.share_heartbeat_s if section.share == "on_change" else 0.0
            announced.silence = Silence.of(period_s, is_filtered=is_kalman, heartbeat_s=heartbeat_s)
            announced.alone_inputs = self._alone_inputs
        announced.news = News(self.peers, announced.silence)

    def overdue(self, k: int) -> float:
        """Return by how many ticks the oldest news of the others on the roster is older than usual."""
        return max((self.announced.overdue(agent, k, k) for agent in self.peers), default=0.0)

    def alone(self, uav: int, tick: int) -> tuple[AloneLaw, Course]:
        """Return control law and course of a UAV, 0-based, alone."""
        return self._alone.law(uav), self._alone.course(uav, tick)

    def _alone_inputs(self, uav: int, tick: int, x: Array) -> Array:
        """Return the inputs of a UAV alone, (4,), whose integral holds its part of the estimated forces."""
        forces, held_I = self.forces, None
        if forces is not None:
            forces = self._controller.model.at_rest(forces)
            own = slice(3 + 3 * uav, 6 + 3 * uav)
            held_I = -(forces[own] + forces[:3] / self._setup.system.N)
        return self._alone.inputs(uav, x[: self._setup.system.n], tick, held_I)

    @property
    def forces(self) -> Array | None:
        """Estimated external forces, (3 + 3 N,), inertial frame, N; None where they are not estimated."""
        return self._filtered if self._disturbance is None else self._disturbance.forces

    def update(self, known: Known) -> Array:
        """Take in what is known at a tick and return the estimated state, (n,); with motor lag (n + m,)."""
        k = known.measurement.tick
        self._update_roster(known)
        for plan in known.plans:
            self.announced.add(plan)
            self.estimator.take(plan)
        self._observe_news(k)
        for measurement in known.measurements:
            self.estimator.measure(measurement)
        x = self.estimator.estimate(k, self.announced)
        if self._kalman is not None and self.estimator.belief is not None:
            self._filtered = self._kalman.forces(self.estimator.belief)
        if self._setup.scenario.controller.received_states == "as_received":
            x = x.copy()
            for plan in filter(None, (self.announced.newest(agent, before=k) for agent in self.peers)):
                for uav, block in zip(plan.uavs, plan.uav_states, strict=True):
                    x[state.uav_slice(uav - 1)] = block
        return x

    def _observe_news(self, k: int) -> None:
        """Take in how old the newest plans of the others are."""
        announced = self.announced
        if not self._began:
            self._began, announced.began = True, k
        newest = {agent: announced.newest(agent, before=k) for agent in self.peers}
        announced.news.observe({agent: k - plan.tick for agent, plan in newest.items() if plan is not None})

    def reported(self, k: int, x: Array) -> Array:
        """Return what a plan of tick k says of the own UAVs: their states, (owned, 12), in an estimate, (n,).

        With vehicle sensors it says the measurements and inputs of the last ticks instead, (owned, 80).
        """
        if self._kalman is None:
            return state.StateView(x[: self._setup.system.n]).uavs[list(self._owned)]
        return self.estimator.reports(k, self._owned)

    def _update_roster(self, known: Known) -> None:
        """Take in the roster of a tick; all agents do that at the same tick."""
        tick, controller, announced = known.measurement.tick, self._controller, self.announced
        off_roster = announced.off_roster = set(self._setup.agents) - known.agents
        if controller.regulation.advance(tick):
            announced.law_since = tick
        # An agent that starts has no control law for the meantime.
        since = tick if known.ticks_since_start > 0 else None
        if (known.off, known.released) != self._failed:
            self._update_failures(known, since)
        if off_roster == self._off_roster:
            return
        for agent in self._off_roster - off_roster:
            announced.forget(agent)
        for agent in off_roster - self._off_roster:
            # The last plan of an agent that leaves may not have been received: docs/equations.md (32b).
            newest = announced.newest(agent, before=tick)
            if self.expected is not None and newest is not None and newest.tick < tick - 1:
                start, prediction, inputs = self.expected
                announced.assume(agent, start, controller.foreseen(prediction, inputs))
        self._off_roster, announced.law_since = off_roster, tick
        controller.without([uav for agent in sorted(off_roster) for uav in self._setup.owned[agent - 1]], since)

    def _update_failures(self, known: Known, since: int | None) -> None:
        """Switch to model and control law of the remaining UAVs, as further UAVs have failed."""
        (known_off, known_released), self._failed = self._failed, (known.off, known.released)
        stopped, cut = sorted(known.off - known_off - known.released), sorted(known.released - known_released)

        def moved(x: Array) -> Array:
            for uav in stopped:
                x = motor_off_state(x, uav)
            for uav in cut:
                x = released_state(x, uav)
            return x

        controller, failed = self._controller, min(known.measurement.tick, known.failed_since)
        controller.fail(known.off, known.released, since)
        self._alone.fail(known.off, known.released)
        self.announced.fail_safe, self.announced.failed_since = controller.regulation.fail_safe, failed
        self.estimator.change(failed, controller.model, moved)
        left = [uav for uav in self._owned if uav not in known.off]
        if self._disturbance is not None and left:
            self._disturbance.rebuild(controller.model, controller.regulation.hover, left)

    def _law_inputs(self, tick: int, x: Array) -> Array | None:
        """Return inputs of all UAVs by the shared control law, without corrections, (m,); None for open loop.

        Cached by tick: the inputs are needed for each of the others, and those of a past tick again at later ticks.
        """
        forces, regulation = self.forces, self._controller.regulation
        key = x, forces, regulation.version
        cached, inputs = self._law_cache.get(tick, ((None,) * 3, None))
        if any(new is not old for new, old in zip(key, cached, strict=True)):
            inputs = regulation.inputs(x, self._setup.X_ref[tick], forces, tick)
            self._law_cache[tick] = key, inputs
            if len(self._law_cache) > 2 * WINDOW:
                del self._law_cache[min(self._law_cache)]
        return inputs

    def _reference(self, tick: int) -> Array:
        """Return the reference state at a tick, (n,); with motor lag (n + m,), the actual inputs those of hover."""
        reference: Array = self._setup.X_ref[tick].copy()
        return np.concatenate([reference, self._setup.hover.u]) if self._setup.settings.motor_lag_s else reference
