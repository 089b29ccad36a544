"""State and inputs of the team as one agent estimates them, through rosters and failures."""

from collections.abc import Callable, Iterable

import msgspec
import numpy as np

from transport.agent.communication.announced_inputs import AnnouncedInputs
from transport.agent.communication.unannounced_inputs import SharedLaw
from transport.agent.estimation.estimator import estimator_of
from transport.agent.estimation.law_inputs import LawInputs
from transport.agent.estimation.predicted_motion import Failure
from transport.agent.received import Received
from transport.agent.silence.integrator_states import IntegratorForces
from transport.agent.silence.silence_thresholds import LESS_THAN_OTHERS, Silence
from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.hover import motor_off_state, released_state
from transport.mpc.alone.alone_law import AloneLaw
from transport.mpc.alone.uav_motion import Setpoint
from transport.mpc.controller import Controller
from transport.mpc.law.laws_of_uavs_alone import AloneTeam
from transport.mpc.program.corrections_along_reference import Course
from transport.mpc.program.prediction import Prediction
from transport.protocol.scenario.setup.team_run import TeamRun

_NO_UAVS: frozenset[int] = frozenset()


class Expected(msgspec.Struct, frozen=True, kw_only=True):
    """Prediction of the last step, which foresees the inputs of an agent that leaves, (32b)."""

    start: int  # its first tick
    prediction: Prediction | Course
    inputs: Array  # own ones, (N_p, 4 owned)


class TeamEstimate:
    """Estimate of one agent, 1-based; its controller is kept up to date with the team.

    Without a shared law (a controller of the user) the others are assumed to apply their plans.

    Attributes:
        peers: The other agents.
        announced: Inputs announced by all agents.
        estimator: Estimated states, by tick.
        expected: Prediction of the last step with a shared control law.
    """

    def __init__(
        self, setup: TeamRun, agent: int, controller: Controller, *, has_shared_law: bool = True
    ) -> None:
        self._setup = setup
        self._has_shared_law = has_shared_law
        self._agent = agent
        self._controller = controller
        self.peers = tuple(other for other in setup.agents if other != agent)
        self._all_agents = set(setup.agents)
        self._agents_off_roster: set[int] = set()  # the controller leaves them out
        self.restart()

    def restart(self) -> None:
        """Reset for a new start in the run, as an agent has that was off the roster.

        The controller, and which agents it leaves out, stay as they are. Failures are told again by
        the first roster, for the new estimator.
        """
        setup = self._setup
        regulation = self._controller.regulation
        # The order matters: `_shared_law` refers to the estimator, and `announced` to that law.
        self.estimator = estimator_of(setup, self._agent, self._reference, regulation.gain)
        self._law_inputs = LawInputs(regulation, setup.X_ref)
        reference = setup.reference.sampled
        self._alone = AloneTeam(setup.model, setup.hover, setup.settings, regulation, reference)
        self.announced = AnnouncedInputs(
            setup.owned,
            setup.hover.u,
            setup.settings.received_plans,
            own=self._agent,
            law=self._shared_law(),
            settings=setup.settings,
        )
        self.announced.fail_safe = regulation.fail_safe
        self._integrator_forces = IntegratorForces(setup.settings.sampling_period_s)
        self.expected: Expected | None = None
        self._has_landed = False
        self._forces_in_flight = self.estimator.forces
        self._motors_off = _NO_UAVS  # UAVs, 0-based
        self._released = _NO_UAVS  # those of them that are released

    def _shared_law(self) -> SharedLaw:
        """Return how the others are assumed to act; with closed-loop prediction also alone."""
        if not self._has_shared_law:
            return SharedLaw()
        section = self._setup.settings
        inputs, start_state = self._by_law, self.estimator.start_state
        if section.silence == "law" or section.prediction != "closed_loop":
            return SharedLaw(inputs=inputs, start_state=start_state)
        silence = Silence.of(
            section.sampling_period_s,
            is_filtered=section.estimator == "kalman",
            heartbeat_s=section.share_heartbeat_s if section.share == "on_change" else 0.0,
        )
        return SharedLaw(
            inputs=inputs,
            start_state=start_state,
            silence=silence,
            silence_after_failures=silence.after_failures,
            inputs_alone=self._by_law_alone,
        )

    def share_alone(self, k: int) -> float:
        """Return the share, 0 to 1, with which the agent is to act alone at tick k: (32c).

        To be called after `announced.heard.observe` of that tick. It is the larger of two: the share
        that follows from the oldest information, and the largest that one of the others announces, less
        `LESS_THAN_OTHERS`. A UAV alone gives way to the payload's swing; one of the others that acts
        with the team meanwhile would turn the payload.
        """
        heard = self.announced.heard
        silence = heard.silence
        if silence is None:
            return 0.0
        # Its UAVs have been alone before a start in mid-run, and go on until the agent has information.
        if heard.lacks_first_information(before=k):
            return 1.0
        by_age = silence.alone(heard.oldest_information)
        by_others = heard.most_said(before=k) - LESS_THAN_OTHERS
        return max(by_age, by_others)

    def alone(self, uav: int, tick: int) -> tuple[AloneLaw, Setpoint]:
        """Return control law and setpoint of a UAV, 0-based, alone."""
        return self._alone.law(uav), self._alone.setpoint(uav, tick)

    def alone_ahead(self, uav: int, first: int, steps: int) -> Array:
        """Return the inputs of the setpoints of a UAV, 0-based, alone, over a horizon, (steps, 4)."""
        return self._alone.setpoint_inputs(uav, first, steps)

    def _by_law_alone(self, uav: int, tick: int, x: Array) -> Array:
        """Return the inputs of a UAV alone, (4,): its integral has followed its part of the forces."""
        integral_I = self._integrator_forces.part(uav, self._motors_off)
        return self._alone.inputs(uav, x[: self._setup.system.n], tick, integral_I)

    def follow(self, setup: TeamRun) -> None:
        """Take the reference from a run with a further target."""
        self._setup = setup
        reference = setup.reference.sampled
        self._law_inputs.follow(setup.X_ref)
        completed = self._controller.regulation.follow(reference)
        self._alone.follow(reference)
        # A new team's law was under way. From the target on it holds; before, another one did, (46).
        if completed and reference.change is not None:
            self.announced.law_since = reference.change.first
        self.announced.fail_safe = self._controller.regulation.fail_safe

    @property
    def forces(self) -> Array | None:
        """External forces to reckon with, inertial frame, N; None where they are not estimated.

        They are the estimated ones; once the load is on the ground those before, as what the ground
        carries is no force that lasts.
        """
        return self._forces_in_flight if self._has_landed else self.estimator.forces

    def update(self, received: Received) -> Array:
        """Take in the messages of a tick; return the estimate, (n,), with motor lag (n + m,)."""
        k = received.tick
        self._update_roster(received)
        for plan in received.plans:
            self.announced.add(plan)
            self.estimator.take(plan)
        self.announced.heard.observe(k)
        for measurement in received.measurements:
            self.estimator.measure(measurement)

        x = self.estimator.estimate(k, self.announced)
        targets = self._setup.maneuver.targets
        landing = targets[-1] if targets and targets[-1].lands else None
        time_s = k * self._setup.settings.sampling_period_s
        self._has_landed = landing is not None and time_s >= landing.ends_s
        if not self._has_landed:
            self._forces_in_flight = self.estimator.forces
        self._hold_forces(k)
        if self._setup.settings.received_states == "as_received":
            return self._as_received(x, k)
        return x

    def _hold_forces(self, k: int) -> None:
        """Follow the estimated forces as the integrals of UAVs alone do: (32f)."""
        if self.forces is None:
            return
        share_alone = self.share_alone(k)
        # The team's estimate of drag: own measurements alone do not tell it.
        if share_alone < 1.0 and len(self.forces) > 4 + 3 * self._setup.system.N:
            self._alone.assume_drag(self.forces[-2:])
        # The law of any UAV will do: all have the same gains, and with them the same time constant.
        self._integrator_forces.follow(
            self._controller.model.with_weight_of_mass_error(self.forces),
            share_alone=share_alone,
            follows_s=self._alone.law(0).follows_s,
        )

    def _as_received(self, x: Array, k: int) -> Array:
        """Return an estimate of tick k with the others' states as received, whatever their age."""
        x = x.copy()
        for agent in self.peers:
            plan = self.announced.plans.newest(agent, before=k)
            if plan is None:
                continue
            for uav, block in zip(plan.uavs, plan.uav_states, strict=True):
                x[state.uav_slice(uav - 1)] = block
        return x

    def _is_alone(self, agent: int, tick: int) -> bool:
        """Return whether another agent is assumed to act wholly alone at a tick."""
        plan = self.announced.plans.newest(agent, before=tick, started=tick)
        return self.announced.heard.share_alone(agent, plan, tick) == 1.0

    def _update_roster(self, received: Received) -> None:
        """Take in the roster of a tick; all agents do that at the same tick."""
        tick = received.tick
        announced = self.announced
        off_roster = self._all_agents - received.agents
        leaving = off_roster - self._agents_off_roster
        returning = self._agents_off_roster - off_roster
        # Asked before they are off the roster: an agent that is off counts as informed.
        were_alone = {agent for agent in leaving if self._is_alone(agent, tick)}
        announced.heard.off_roster = off_roster
        if self._controller.regulation.advance(tick):
            announced.law_since = tick

        # An agent that starts has no control law for the meantime.
        since = tick if received.ticks_since_start > 0 else None
        if (received.off, received.released) != (self._motors_off, self._released):
            self._update_failures(received, since)

        if off_roster == self._agents_off_roster:
            return
        for agent in returning:
            announced.begin_anew(agent, tick)
        for agent in leaving:
            self._assume_last_plan(agent, tick, is_alone=agent in were_alone)
        self._agents_off_roster = off_roster
        announced.law_since = tick
        owned = self._setup.owned
        uavs_without_agent = [uav for agent in sorted(off_roster) for uav in owned[agent - 1]]
        self._controller.without(uavs_without_agent, since)

    def _assume_last_plan(self, agent: int, tick: int, *, is_alone: bool) -> None:
        """Assume inputs for an agent that departed at a tick, if its last plan has not been received.

        One that acted alone is assumed on its fail-safe at once: its last plan is short.
        Source: docs/equations.md (32b).
        """
        newest = self.announced.plans.newest(agent, before=tick)
        expected = self.expected
        if expected is None or newest is None or newest.tick >= tick - 1:
            return
        U = self._controller.foreseen(expected.prediction, expected.inputs)
        self.announced.assume(agent, expected.start, U[:0] if is_alone else U)

    def _update_failures(self, received: Received, since: int | None) -> None:
        """Switch to model and control law of the remaining UAVs, as further UAVs have failed."""
        stopped = received.off - self._motors_off - received.released
        cut = received.released - self._released
        self._motors_off = received.off
        self._released = received.released

        controller = self._controller
        controller.fail(received.off, received.released, since)
        self._alone.fail(received.off, received.released)

        # An agent that starts in mid-run learns of a failure long past: `failed_since` is earlier. It is
        # later where a roster with another failure is here already, ahead of its tick.
        tick = min(received.tick, received.failed_since)
        owned = self._setup.owned[self._agent - 1]
        self.announced.fail_safe = controller.regulation.fail_safe
        self.announced.heard.failed_since = tick
        self.estimator.change(
            Failure(
                tick=tick,
                model=controller.model,
                hover=controller.regulation.hover,
                moved=_failed_state(sorted(stopped), sorted(cut)),
                own_left=[uav for uav in owned if uav not in received.off],
            )
        )

    def _by_law(self, tick: int, x: Array) -> Array | None:
        """Return the inputs of all UAVs by the shared control law without corrections, (m,).

        None with open-loop prediction.
        """
        return self._law_inputs.inputs(tick, x, self.forces)

    def _reference(self, tick: int) -> Array:
        """Return the reference state at a tick, (n,).

        With motor lag (n + m,), the actual inputs those of hover.
        """
        x_ref: Array = self._setup.X_ref[tick].copy()
        if self._setup.settings.motor_lag_s:
            return np.concatenate([x_ref, self._setup.hover.u])
        return x_ref


def _failed_state(stopped: Iterable[int], cut: Iterable[int]) -> Callable[[Array], Array]:
    """Return the map of a state to that after some UAVs have stopped, and some are cut off."""

    def moved(x: Array) -> Array:
        for uav in stopped:
            x = motor_off_state(x, uav)
        for uav in cut:
            x = released_state(x, uav)
        return x

    return moved
