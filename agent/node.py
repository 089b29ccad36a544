"""An agent as a state machine: one measurement in, one plan out.

Tick k opens for the agent with its measurement. In lockstep it waits for the plans of k - 1 that the clock
waited for (they may still be on their way from their senders), estimates the state, plans, and answers; with
several rounds it exchanges plans with the others within the tick before that. In real time it waits for
nobody: whatever is here when it gets round to it counts, and of several measurements the newest.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from agent.announced import AnnouncedInputs
from agent.disturbance import DisturbanceEstimator
from agent.estimator import WINDOW, StateEstimator
from agent.sharing import Sharing
from model import state
from model.arrays import Array, ShapeError
from model.discretisation import Discrete
from model.failure import motor_off_state, released_state
from model.state import input_indices
from mpc.controller import Controller, Linear, StepResult
from mpc.fail_safe import FailSafe
from mpc.feedback import FeedbackLaw, Regulator
from mpc.prediction import Prediction
from mpc.regulation import CostToGo
from protocol.admission.arrivals import Arrivals
from protocol.admission.membership import Membership
from protocol.admission.plausibility import check_moment
from protocol.admission.reception import Reception
from protocol.scenario.links import LinkChanges
from protocol.scenario.setup import Setup
from protocol.wire.messages import (
    STAGES,
    Control,
    Event,
    LinkChange,
    Measurement,
    Message,
    MessageError,
    Plan,
    Presence,
    Roster,
    StepReport,
    agent_name,
)
from protocol.wire.outbox import Outbox, lost

# Integration steps for looking one period ahead with actuation "next_tick"; see `agent.estimator`.
_AHEAD_STEPS = 2

# The stages of a step that are its work.
_BEFORE_ROUNDS, _IN_A_ROUND = ("estimate", "linearise", "discretise"), ("condense", "solve")


@dataclass(slots=True, kw_only=True)
class _Step:
    """One tick's problem while it is worked on: what all rounds of negotiation have in common, and the last answer."""

    measurement: Measurement
    usable: Sequence[Plan]
    lost: int
    measured: int  # tick of the newest measurement used, -1 for none
    force: Array  # estimated external force on the payload
    uav_states: Array
    start: int
    y_ref: Array
    U: Array
    law: FeedbackLaw | None
    end: CostToGo | None
    linear: Linear
    discrete: Discrete | None
    negotiation: int  # exchanges still to come
    optimum: StepResult | None = None
    times_ns: dict[str, int] = field(default_factory=lambda: dict.fromkeys(STAGES, 0))


class AgentNode:
    """One agent of a run.

    Args:
        setup: The run.
        agent: Which agent, 1-based.
        incarnation: Which start of this process.
        stopwatch: Nanoseconds of a steady clock, for the step report only.
    """

    def __init__(
        self, setup: Setup, agent: int, incarnation: int = 0, stopwatch: Callable[[], int] = lambda: 0
    ) -> None:
        self.name = agent_name(agent)
        self._agent = agent
        self._setup = setup
        self._stopwatch = stopwatch
        owned = setup.owned[agent - 1]
        self._uavs = tuple(uav + 1 for uav in owned)
        self._own = input_indices(owned)
        self._own_states = np.concatenate([np.arange(state.PER_UAV) + state.uav_slice(uav).start for uav in owned])
        self._y_ref, self._x_ref = setup.Y_ref, setup.X_ref
        self._controller = Controller(setup.model, setup.hover, setup.settings, owned, self._x_ref)
        self._peers = tuple(other for other in setup.agents if other != agent)
        clock = setup.scenario.clock
        self._waits = clock.mode == "lockstep"
        self._membership = Membership()
        self._gone: set[int] = set()  # agents the controller does not count on
        self.publish_ns = 0
        self._reception = Reception(setup, self._handle, self._newest_tick)
        self.rejected = self._reception.rejected
        self.finished: Control | None = None
        self._begin(incarnation)

    def _begin(self, incarnation: int) -> None:
        """Start anew under an incarnation: nothing is remembered of the flight but the roster."""
        setup, clock = self._setup, self._setup.scenario.clock
        self.incarnation = incarnation
        self._out = Outbox(self.name, incarnation)
        fail_safe = FailSafe(setup.system, setup.hover.u)
        alignment = setup.scenario.controller.received_plans
        self._announced = AnnouncedInputs(
            setup.owned,
            setup.hover.u,
            fail_safe,
            alignment,
            own=self._agent,
            law=self._by_law,
            past=self._known,
            limits=setup.settings.limits,
        )
        period_s, disturbance = setup.settings.sampling_period_s, setup.scenario.controller.disturbance
        self._disturbance: DisturbanceEstimator | None = None
        if disturbance.estimate:
            self._disturbance = DisturbanceEstimator(
                setup.model, setup.hover, setup.owned[self._agent - 1], period_s, disturbance.time_constant_s
            )
        self._estimator = StateEstimator(setup.model, self._planned, period_s, self._disturbance)
        speed = None if self._waits else clock.speed
        senders = [agent_name(peer) for peer in self._peers]
        self._plans: Arrivals[Plan] = Arrivals(
            {sender: setup.link(sender, self.name) for sender in senders}, after=1, speed=speed
        )
        self._measurements: Arrivals[Measurement] = Arrivals(
            {"plant": setup.link("plant", self.name)}, after=0, speed=speed
        )
        links = [*self._plans.links.values(), *self._measurements.links.values()]
        self._link_changes = LinkChanges(links, setup.samples_s)
        self._measurement: Measurement | None = None  # of the open tick, until it is worked on
        self._step: _Step | None = None  # being negotiated
        self._failed: tuple[frozenset[int], frozenset[int]] = frozenset(), frozenset()  # UAVs off, and released
        self._arrived: dict[int, set[int]] = {}  # whose plans are physically here, by tick
        self._proposals: dict[tuple[int, int], dict[int, Plan]] = {}  # by tick and negotiation, and agent
        limits, uavs = setup.settings.limits, len(self._uavs)
        # What the last step expected of all: start, prediction, law, own inputs.
        self._foreseen: tuple[int, Prediction, FeedbackLaw, Array] | None = None
        self._law_at: dict[int, tuple[Array, Array | None, Regulator | None, Array | None]] = {}  # `_by_law`, by tick
        self._sharing = Sharing(setup.scenario.controller, limits.lower(uavs), limits.upper(uavs))
        self._last_tick = -1
        # Plans that came while it was not on the roster as it knows it: those of two ticks.
        self._early: deque[Plan] = deque(maxlen=2 * len(self._peers) * setup.scenario.controller.negotiation_iterations)
        self._idle_since_ns = self._stopwatch()

    @property
    def wake_ns(self) -> int | None:
        """At once when there is a measurement to work on and nobody to wait for."""
        return 0 if self._measurement is not None and not self._waits else None

    def receive(self, event: Event, now_ns: int) -> Sequence[Message]:
        """Take in the roster, measurements and the others' plans."""
        match event:
            case Message():
                self._reception.receive(event, now_ns)
            case Presence(name="coordinator", alive=False):
                self.finished = lost(self._out, self._last_tick, "coordinator is gone")
            case Presence(alive=False):
                self._membership.close(event.name, event.incarnation)
        return self._work(now_ns) if self._waits and self.finished is None else ()

    def poll(self, now_ns: int) -> Sequence[Message]:
        """In real time, work on the newest measurement once everything that is here has been taken in."""
        return () if self._waits else self._work(now_ns)

    def warm_up(self) -> None:
        """Take a step nobody sees, so that the first one of the flight is not slower than the others."""
        controller, hover = self._controller, self._setup.hover
        U = np.tile(hover.u, (self._setup.settings.horizon, 1))
        forces = None if self._disturbance is None else self._disturbance.forces
        law = controller.law(hover.x, np.tile(hover.x, (len(U), 1)), np.zeros_like(U), forces)
        y_ref = np.tile(self._setup.model.outputs(hover.x), (len(U) + 1, 1))
        controller.step(hover.x, hover.u, U, y_ref, law, forces, end=controller.end(hover.x, hover.x, forces))
        self._setup.model.integrate(hover.x, hover.u, self._setup.settings.sampling_period_s, _AHEAD_STEPS)

    def _handle(self, message: Message, now_ns: int) -> None:
        """Take in a message that passed the checks of the reception."""
        match message:
            case Control():
                self.finished = message
            case Roster():
                for plan in self._enlist(message):
                    self._reception.receive(plan, now_ns)
            case LinkChange():
                self._link_changes.apply(message)
            case Measurement():
                self._measure(message, now_ns)
            case Plan() if self._membership.admits(message):
                self._take(message, now_ns)

    def _newest_tick(self) -> int | None:
        """Return the newest tick this agent knows of, or None while it is not on the roster."""
        joined = self._membership.since.get(self._agent)
        return None if joined is None else max(self._last_tick, joined - 1)

    def _enlist(self, roster: Roster) -> list[Plan]:
        """Take in a roster and return the plans that were ahead of it."""
        was_on_it = self._membership.incarnation(self._agent) == self.incarnation
        waiting = self._membership.update(roster)
        if was_on_it and self._membership.incarnation(self._agent) != self.incarnation:
            # Taken for dead: whatever this process knows may be long out of date. It comes back as a new one.
            self._begin(self.incarnation + 1)
        early = list(self._early)
        self._early.clear()
        return [*early, *waiting]

    def _measure(self, measurement: Measurement, now_ns: int) -> None:
        if measurement.uavs != self._uavs:
            raise MessageError("wrong_uavs", f"measurement of UAVs {list(measurement.uavs)}")
        newest = self._last_tick if self._measurement is None else self._measurement.tick
        last = self._setup.ticks
        now = self._newest_tick()
        if now is not None:
            last = now + self._reception.window
        elif measurement.roster <= self._membership.version:
            raise MessageError("past", f"measurement of tick {measurement.tick}, without this start on the roster")
        if self._waits and self._measurement is not None:
            last = newest  # nothing comes before that is answered
        check_moment(measurement, newest + 1, last)
        self._measurement = measurement
        self._measurements.put(measurement, now_ns)

    def _take(self, plan: Plan, now_ns: int) -> None:
        if plan.agent == self._agent:
            raise MessageError("wrong_sender", "plan of this process itself")
        now = self._newest_tick()
        if now is None:
            self._early.append(plan)
            return
        check_moment(plan, 0, now + self._reception.window)
        if plan.tick < self._membership.since[self._agent]:
            return
        if plan.negotiation > 0:
            self._proposals.setdefault((plan.tick, plan.negotiation), {})[plan.agent] = plan
            return
        self._arrived.setdefault(plan.tick, set()).add(plan.agent)
        self._plans.put(plan, now_ns)

    def _work(self, now_ns: int) -> list[Message]:
        """Do whatever has become possible."""
        out: list[Message] = []
        if self._measurement is not None and self._step is None and self._has_plans_for(self._measurement):
            measurement, self._measurement = self._measurement, None
            self._step = self._open(measurement, now_ns)
            out += self._plan(self._step)
        while self._step is not None and self._has_proposals_for(self._step):
            self._adopt(self._step)
            out += self._plan(self._step)
        return out

    def _meet_team(self, measurement: Measurement) -> None:
        """Take note of who takes part from this tick on: the same for everybody at the same tick."""
        gone = set(self._setup.agents) - self._membership.agents_at(measurement.roster)
        self._announced.gone = gone
        self._meet_failures(measurement)
        if gone == self._gone:
            return
        for agent in self._gone - gone:
            self._announced.forget(agent)
        for agent in gone - self._gone:
            self._guess_last_plan(agent, measurement.tick)
        self._gone, self._announced.law_since = gone, measurement.tick
        self._controller.without([uav for agent in sorted(gone) for uav in self._setup.owned[agent - 1]])

    def _guess_last_plan(self, agent: int, tick: int) -> None:
        """Where the last plan of an agent that has left is not here, its actuators play on what was expected of it.

        Args:
            agent: That is off the roster from a tick on.
            tick: That tick.
        Source: docs/equations.md (32b).
        """
        newest = self._announced.newest(agent, before=tick)
        if self._foreseen is not None and newest is not None and newest.tick < tick - 1:
            start, prediction, law, inputs = self._foreseen
            self._announced.leave(agent, start, self._controller.foreseen(prediction, law, inputs))

    def _meet_failures(self, measurement: Measurement) -> None:
        """Take note of UAVs that have failed: from this tick on model and control law are those of what is left."""
        off, released = self._membership.failed_at(measurement.roster)
        known_off, known_released = self._failed
        if (off, released) == self._failed:
            return
        self._failed = off, released
        stopped, cut = sorted(off - known_off - released), sorted(released - known_released)

        def moved(x: Array) -> Array:
            for uav in stopped:
                x = motor_off_state(x, uav)
            for uav in cut:
                x = released_state(x, uav)
            return x

        controller, since = self._controller, min(measurement.tick, self._membership.failed_since)
        controller.fail(off, released)
        self._estimator.change(since, controller.model, moved)
        self._announced.failed_since = since
        left = [uav for uav in self._setup.owned[self._agent - 1] if uav not in off]
        if self._disturbance is not None and left:
            self._disturbance.rebuild(controller.model, controller.regulation.hover, left)

    def _has_plans_for(self, measurement: Measurement) -> bool:
        """Whether the roster is here, and the plans of the tick before from those on it that shared one."""
        if not self._waits:
            return True
        if measurement.roster > self._membership.version:
            return False
        if measurement.tick - 1 < self._membership.since.get(self._agent, 0):
            return True  # what was sent before this process took part is not for it
        senders = set(measurement.shared) & self._membership.took_part(measurement.tick - 1) - {self._agent}
        return senders <= self._arrived.get(measurement.tick - 1, set())

    def _has_proposals_for(self, step: _Step) -> bool:
        """Whether everybody's last plan of this tick's negotiation is here."""
        here = self._proposals.get((step.measurement.tick, step.negotiation), {})
        return self._membership.agents - {self._agent} <= here.keys()

    def _open(self, measurement: Measurement, now_ns: int) -> _Step:
        """What is known at a tick, and the problem that follows from it."""
        watch = [self._stopwatch()]
        k, controller = measurement.tick, self._controller
        period_s = self._setup.settings.sampling_period_s
        steps = self._setup.settings.horizon
        self._last_tick = k
        self._meet_team(measurement)

        # A message is usable when its link says, however early it is here; in an order of its own.
        usable, lost = self._plans.take(k, now_ns)
        self._arrived = {tick: agents for tick, agents in self._arrived.items() if tick >= k}
        self._proposals = {at: plans for at, plans in self._proposals.items() if at[0] >= k}
        for plan in usable:
            self._announced.add(plan)
            self._estimator.take(plan)
        for seen in self._measurements.take(k, now_ns)[0]:
            self._estimator.measure(seen)
        x = self._estimator.estimate(k, self._announced)
        if self._setup.scenario.controller.received_states == "as_received":
            x = self._unpredicted(x, k)
        forces = None if self._disturbance is None else self._disturbance.forces
        if self._setup.scenario.clock.next_tick:
            start, u0 = k + 1, self._announced.at(k, before=k, x=x)
            x0, _ = controller.model.integrate(x, u0, period_s, _AHEAD_STEPS, forces=forces)
        else:
            start, x0, u0 = k, x, self._in_force(k)
        U = self._announced.sequence(start, steps, before=k)
        c = self._announced.corrections(start, steps, before=k)
        law = controller.law(x0, self._x_ref[start : start + steps], c, forces, start)
        end = controller.end(x0, self._x_ref[start + steps], forces, start + steps)
        watch.append(self._stopwatch())
        linear = controller.linearise(x0, u0, forces)
        watch.append(self._stopwatch())
        try:
            discrete = controller.discretise(linear)
        except ShapeError:
            discrete = None  # the others' states, or this flight, are beyond all bounds
        if law is not None and discrete is not None:
            foreign = self._announced.of_another_law(before=k)
            columns = [input_indices(self._setup.owned[agent - 1]) for agent in foreign]
            law = controller.adapted(law, discrete, u0, U, np.concatenate(columns)) if columns else law
        watch.append(self._stopwatch())
        step = _Step(
            measurement=measurement,
            usable=usable,
            lost=lost,
            measured=self._estimator.measured,
            force=np.zeros(3) if forces is None else forces[:3],
            uav_states=x[self._own_states].reshape(len(self._uavs), -1),
            start=start,
            y_ref=self._y_ref[start : start + steps + 1],
            U=U,
            law=law,
            end=end,
            linear=linear,
            discrete=discrete,
            negotiation=self._setup.scenario.controller.negotiation_iterations,
        )
        step.times_ns["wait"] = watch[0] - self._idle_since_ns
        for stage, (begun, done) in zip(_BEFORE_ROUNDS, pairwise(watch), strict=True):
            step.times_ns[stage] = done - begun
        return step

    def _plan(self, step: _Step) -> list[Message]:
        """Solve, and announce the result: to the others' next round, or as the tick's answer."""
        controller = self._controller
        watch = [self._stopwatch()]
        if step.discrete is None:
            optimum = controller.give_up(step.U, step.law)
            watch += [self._stopwatch(), self._stopwatch()]
        else:
            with np.errstate(over="ignore", invalid="ignore"):
                prediction = controller.predict(step.linear, step.discrete, step.U, step.law)
                qp = controller.condense(step.linear, prediction, step.U, step.y_ref, step.law, step.end)
                watch.append(self._stopwatch())
                ticks_since_start = step.measurement.tick - self._membership.since.get(self._agent, 0)
                optimum = controller.conclude(controller.solve(qp), prediction, step.U, step.law, ticks_since_start)
                watch.append(self._stopwatch())
                if step.law is not None:
                    self._foreseen = step.start, prediction, step.law, optimum.U
        step.optimum = optimum
        for stage, (begun, done) in zip(_IN_A_ROUND, pairwise(watch), strict=True):
            step.times_ns[stage] += done - begun
        step.negotiation -= 1
        k, roster = step.measurement.tick, step.measurement.roster
        plan = self._out.stamp(
            Plan,
            tick=k,
            agent=self._agent,
            start_tick=step.start,
            uavs=self._uavs,
            uav_states=step.uav_states,
            inputs=optimum.U,
            corrections=optimum.c,
            status=optimum.solution.status,
            negotiation=step.negotiation,
            shared=step.negotiation > 0 or self._sharing.decide(k, step.start, optimum.c, roster),
        )
        if step.negotiation > 0:
            return [plan]
        self._step = None
        self._announced.add(plan)
        report = self._report(step, optimum)
        self._idle_since_ns = self._stopwatch()
        return [plan, report]

    def _adopt(self, step: _Step) -> None:
        """Take the others' last plans, as far as the links pass them at once, and the own one, into the next round."""
        k = step.measurement.tick
        proposals = self._proposals.pop((k, step.negotiation), {})  # of nobody where there is no other
        U, c = step.U.copy(), None if step.law is None else step.law.c.copy()
        known: list[tuple[npt.NDArray[np.intp], Array, Array]] = []
        for agent, plan in sorted(proposals.items()):
            if 0.0 in self._plans.links[plan.sender].delays(k, step.negotiation):
                columns = input_indices(self._setup.owned[agent - 1])
                known.append((columns, plan.inputs, plan.corrections))
        if step.optimum is not None:
            known.append((self._own, step.optimum.U, step.optimum.c))
        for columns, inputs, corrections in known:
            if len(inputs) == len(U):
                U[:, columns] = inputs
            if c is not None and len(corrections) == len(c):
                c[:, columns] = corrections
        step.U = U
        if step.law is not None and c is not None:
            step.law = replace(step.law, c=c)

    def _in_force(self, k: int) -> Array:
        """Inputs until now: what the own actuators report if that is known, and what everybody announced."""
        u = self._setup.hover.u.copy()
        if k > 0:
            u = self._announced.at(k - 1, before=k, x=self._estimator.known(k - 1))
        reported = self._estimator.reported_inputs(k)
        if reported is not None:
            u[self._own] = reported.reshape(-1)
        return u

    def _unpredicted(self, x: Array, k: int) -> Array:
        """The estimate with the others' states as they were when they sent them, however long ago that was."""
        x = x.copy()
        for plan in filter(None, (self._announced.newest(agent, before=k) for agent in self._peers)):
            for uav, block in zip(plan.uavs, plan.uav_states, strict=True):
                x[state.uav_slice(uav - 1)] = block
        return x

    def _known(self, tick: int) -> Array | None:
        return self._estimator.known(tick)

    def _by_law(self, tick: int, x: Array) -> Array | None:
        """Inputs of all UAVs by the shared control law, without corrections, (m,); None with open-loop prediction."""
        forces = None if self._disturbance is None else self._disturbance.forces
        regulation = self._controller.regulation
        # Asked for each of the others, and at one past instant again at each tick.
        kept = self._law_at.get(tick)
        if kept is None or kept[0] is not x or kept[1] is not forces or kept[2] is not regulation.regulator:
            inputs = regulation.inputs(x, self._x_ref[tick], forces, tick)
            kept = self._law_at[tick] = x, forces, regulation.regulator, inputs
            if len(self._law_at) > 2 * WINDOW:
                del self._law_at[min(self._law_at)]
        return kept[3]

    def _planned(self, tick: int) -> Array:
        planned: Array = self._x_ref[tick].copy()
        return planned

    def _report(self, step: _Step, optimum: StepResult) -> StepReport:
        k, solution = step.measurement.tick, optimum.solution
        newest = [self._announced.newest(agent, before=k) for agent in self._peers]
        worst = solution.residuals.worst
        step.times_ns["publish"] = self.publish_ns
        step.times_ns["total"] = sum(step.times_ns[stage] for stage in (*_BEFORE_ROUNDS, *_IN_A_ROUND))
        return self._out.stamp(
            StepReport,
            tick=k,
            agent=self._agent,
            status=solution.status,
            solver=solution.solver,
            fallback=solution.fallback,
            iterations=solution.iterations,
            residual=worst if np.isfinite(worst) else -1.0,
            peers=self._peers,
            plan_ages=tuple(-1 if plan is None else k - plan.tick for plan in newest),
            state_ages=tuple(self._estimator.age(agent, k) for agent in self._peers),
            measurement_age=-1 if step.measured < 0 else k - step.measured,
            delivered=len(step.usable),
            lost=step.lost,
            late=sum(plan.tick < k - 1 for plan in step.usable),
            force=step.force,
            times_ms=np.array([step.times_ns[stage] / 1e6 for stage in STAGES]),
        )
