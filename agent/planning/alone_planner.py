"""The controller "alone": each UAV keeps to its own part of the reference by its own sensors.

No message helps it: it is the baseline that tells what the network is worth. An agent applies
docs/equations.md (31a)-(31f) to each of its UAVs. It sends plans, which the plant applies, and
ignores those of the others.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from transport.agent.estimation.filter.belief import Belief
from transport.agent.estimation.received_states import Reports, by_uav
from transport.agent.planning.step_report import step_plan, step_report
from transport.agent.received import Received
from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.obstacles import Obstacle
from transport.mpc.alone.alone_law import steps_alone
from transport.mpc.alone.motion_by_own_sensors import OwnSensors
from transport.mpc.alone.uav_motion import UavMotion, ahead, motion_of
from transport.mpc.law.laws_of_uavs_alone import AloneTeam
from transport.mpc.law.present_law import Regulation
from transport.protocol.scenario.setup.team_run import TeamRun
from transport.protocol.wire.messages import STAGES, Measurement, Message, Plan
from transport.protocol.wire.outbox import Outbox

ALONE = "alone"  # the name of this controller in a scenario


@dataclass(slots=True)
class AloneStep:
    """A tick of the controller, as the node expects of every planner (`agent.planner`)."""

    received: Received
    # Exchanges that the tick still needs. There are none before the plan, which makes it 0: the tick
    # is done.
    negotiation: int = 1


class AlonePlanner:
    """Planner of an agent, 1-based, whose UAVs follow the reference alone; the stopwatch counts ns."""

    def __init__(self, setup: TeamRun, agent: int, stopwatch: Callable[[], int]) -> None:
        self._agent = agent
        self._stopwatch = stopwatch
        self._owned = setup.owned[agent - 1]
        self._peers = tuple(other for other in setup.agents if other != agent)
        self._setup = setup
        # Each UAV follows its part of the motion that the undisturbed team takes under its law, (31f).
        regulation = Regulation(setup.model, setup.hover, setup.settings, setup.reference.sampled)
        self._regulation = regulation
        reference = setup.reference.sampled
        self._team = AloneTeam(setup.model, setup.hover, setup.settings, regulation, reference)
        self.restart()

    def restart(self) -> None:
        """Reset for a new start in the run: integral and rods as on the reference."""
        system = self._setup.system
        ages = self._setup.sensors.ages
        period_s = self._setup.settings.sampling_period_s

        self._measurement: Measurement | None = None  # the newest that is usable
        self._sensed = Reports()  # own measurements of the last ticks
        self._integral_I = {uav: np.zeros(3) for uav in self._owned}
        tensions_N = self._setup.hover.tensions
        self._sensors = {
            uav: OwnSensors(system, uav, float(tensions_N[uav]), ages, period_s)
            for uav in self._owned
        }
        # Inputs of the newest plan, (4 owned,); hover until there is a measurement.
        self._inputs: Array = self._setup.hover.u[state.input_indices(self._owned)]
        self._has_planned = False
        self._failed: tuple[frozenset[int], frozenset[int]] = frozenset(), frozenset()
        self._team.fail((), ())
        self._idle_since_ns = self._stopwatch()

    @property
    def belief(self) -> Belief | None:
        """None: there is no estimate of the team."""
        return None

    def adopt(self, step: AloneStep, proposals: Sequence[Plan]) -> None:
        """Do nothing: there is no negotiation."""

    def follow(self, setup: TeamRun) -> None:
        """Follow the reference of the run with a further target, from that target's tick on."""
        self._setup = setup
        self._regulation.follow(setup.reference.sampled)
        self._team.follow(setup.reference.sampled)

    @property
    def share_alone(self) -> float:
        """0: silence does not change what it does."""
        return 0.0

    def see(self, seen: tuple[Obstacle, ...]) -> None:
        """Do nothing: the path keeps clear of what the agent sees."""

    def announce(self) -> None:
        """Do nothing: all plans are sent."""

    def warm_up(self) -> None:
        """Compute the motion that the UAVs follow: an agent that returns is late otherwise."""
        self._regulation.whole.fail_safe.warm_up()

    def begin(self, received: Received) -> AloneStep:
        """Take in the newest measurement and the failures of UAVs."""
        for measurement in received.measurements:
            if self._measurement is None or measurement.tick > self._measurement.tick:
                self._measurement = measurement
            for uav, report in by_uav(measurement):
                self._sensed.tell(measurement.tick, uav, report)
        self._sensed.forget_before(received.tick - state.REPORTS)
        if self._failed != (received.off, received.released):
            self._failed = received.off, received.released
            self._team.fail(*self._failed)
        return AloneStep(received)

    def plan(self, step: AloneStep, out: Outbox, publish_ns: int) -> list[Message]:
        """Return the tick's plan and report."""
        begun_ns = self._stopwatch()
        step.negotiation = 0
        setup = self._setup
        k = step.received.tick

        # Without a measurement of this tick the inputs stay.
        measured = self._measurement
        if measured is not None and measured.tick == k:
            self._inputs = self._controlled(measured)
        self._has_planned = True
        rows = steps_alone(setup.settings.sampling_period_s)
        inputs = np.tile(self._inputs, (min(rows, setup.settings.horizon), 1))
        states = self._said(k)
        plan = step_plan(k, self._agent, out, setup, uav_states=states, inputs=inputs)

        now_ns = self._stopwatch()
        started_ns = step.received.started_ns
        spent_ns = {
            "wait": started_ns - self._idle_since_ns,
            "publish": publish_ns,
            "solve": now_ns - begun_ns,
        }
        no_ages = (-1,) * len(self._peers)
        report = step_report(
            step.received,
            self._agent,
            out,
            status="solved",
            solver=ALONE,
            fallback=False,
            iterations=0,
            residual=-1.0,
            force=np.zeros(3),
            peers=self._peers,
            plan_ages=no_ages,
            state_ages=no_ages,
            measurement_age=-1 if measured is None else k - measured.tick,
            times_ns={**dict.fromkeys(STAGES, 0), **spent_ns, "total": now_ns - started_ns},
        )
        self._idle_since_ns = self._stopwatch()
        return [plan, report]

    def end(self, tick: int, out: Outbox) -> list[Message]:  # noqa: ARG002
        """Return nothing: this controller has nothing to end with the run."""
        return []

    def _controlled(self, measured: Measurement) -> Array:
        """Return the inputs of the owned UAVs within rates and limits, (4 owned,)."""
        settings = self._setup.settings
        start = measured.tick + int(self._setup.rules.clock.next_tick)
        before = self._inputs_before(measured)
        wanted = []
        for i, uav in enumerate(self._owned):
            law = self._team.law(uav)
            setpoint = self._team.setpoint(uav, start)
            motion = self._motion(i, measured, start, before)
            integral_I = self._integral_I[uav]

            wanted.append(law.inputs(motion, setpoint, integral_I))
            self._integral_I[uav] = law.integral_after(
                integral_I, motion, setpoint, settings.sampling_period_s
            )

        step = settings.largest_step(len(self._owned))
        inputs = np.clip(np.concatenate(wanted), before - step, before + step)
        return np.clip(inputs, settings.lower(len(self._owned)), settings.upper(len(self._owned)))

    def _inputs_before(self, measured: Measurement) -> Array:
        """Return the inputs in force just before the plan starts, (4 owned,).

        The measured ones, or with `next_tick` those that the plan of the tick before is for. An
        agent that has returned has no such plan: its UAVs keep, as far as it knows, what they apply.
        """
        if self._setup.rules.clock.next_tick and self._has_planned:
            return self._inputs
        return measured.inputs.reshape(-1)

    def _motion(self, i: int, measured: Measurement, start: int, before: Array) -> UavMotion:
        """Return the motion of the i-th owned UAV at tick `start` by its own measurements.

        `before` are the inputs of the owned UAVs in force until then, (4 owned,).
        """
        system = self._setup.system
        period_s = self._setup.settings.sampling_period_s
        uav, values, tick = self._owned[i], measured.uav_states[i], measured.tick
        reference = self._reference(uav)
        if self._setup.sensors.vehicle:
            sensors = self._sensors[uav]
            missing = measured.missing[i] if measured.missing else 0
            values = sensors.completed(values, missing, tick)
            sensors.observe(values, float(measured.inputs[i][0]), tick, reference)
            motion = sensors.motion(values, tick, start, reference)
        else:
            x = np.zeros(system.n)
            x[: state.PAYLOAD] = measured.payload
            x[state.uav_slice(uav)] = values
            motion = ahead(motion_of(system, uav, x), tick, start, reference, period_s)
        if start == tick:
            return motion
        here, inputs = self._team.setpoint(uav, tick), before[state.input_slice(i)]
        return self._team.law(uav).driven(motion, here, reference(start), inputs, period_s)

    def _reference(self, uav: int) -> Callable[[int], UavMotion]:
        return lambda tick: self._team.setpoint(uav, tick).motion

    def _said(self, k: int) -> Array:
        """Return the states of the own UAVs for the plan of tick k, as measured, or of their sensors."""
        owned = list(self._owned)
        if self._setup.sensors.vehicle:
            return self._sensed.rows(k, owned)
        if self._measurement is not None:
            return self._measurement.uav_states
        x_ref = self._setup.X_ref[min(k, len(self._setup.X_ref) - 1)]
        return state.StateView(x_ref).uavs[owned]
