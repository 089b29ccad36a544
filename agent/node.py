"""An agent as a state machine: one measurement in, one plan out.

Tick k opens for the agent with its measurement. It waits for the plans of k - 1 that the clock waited for
(they may still be on their way from their senders), estimates the state, plans, and answers.
"""

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from agent.announced import AnnouncedInputs
from agent.estimator import StateEstimator
from model.arrays import Array
from model.state import input_indices
from mpc.controller import Controller, Optimum
from protocol.membership import Membership
from protocol.messages import (
    Control,
    Measurement,
    Message,
    Plan,
    Presence,
    Roster,
    StepReport,
    agent_name,
)
from protocol.outbox import Outbox, lost
from protocol.setup import Setup

# Integration steps for looking one period ahead with actuation "next_tick"; see `agent.estimator`.
_AHEAD_STEPS = 2


class AgentNode:
    """One agent of a run.

    Args:
        setup: The run.
        agent: Which agent, 1-based.
        incarnation: Which start of this process.
        stopwatch: Nanoseconds of a steady clock, for the step report only.
    """

    wake_ns = None

    def __init__(
        self, setup: Setup, agent: int, incarnation: int = 0, stopwatch: Callable[[], int] = lambda: 0
    ) -> None:
        self.name = agent_name(agent)
        self._agent = agent
        self._setup = setup
        self._out = Outbox(self.name, incarnation)
        self._stopwatch = stopwatch
        owned = setup.owned[agent - 1]
        self._uavs = tuple(uav + 1 for uav in owned)
        self._own = input_indices(owned)
        self._controller = Controller(setup.model, setup.hover, setup.settings, owned)
        # References at every instant any horizon reaches: only looked up in flight.
        instants = np.arange(setup.ticks + setup.settings.horizon + 2, dtype=np.float64)
        times = setup.settings.sampling_period_s * instants
        self._y_ref, self._x_ref = setup.reference.outputs(times), setup.reference.states(times)
        self._announced = AnnouncedInputs(setup.owned, setup.hover.u)
        self._estimator = StateEstimator(setup.model, self._planned, setup.settings.sampling_period_s)
        self._peers = tuple(other for other in setup.agents if other != agent)
        self._membership = Membership()
        self._measurement: Measurement | None = None  # of the open tick, until it is answered
        self._links = {peer: setup.link(peer, agent) for peer in self._peers}
        self._arrived: dict[int, set[int]] = {}  # whose plans are physically here, by tick
        self._undelivered: list[tuple[int, Plan]] = []  # plans, with the tick from which the link lets them through
        self._lost: list[int] = []  # ticks of plans that the links lost
        self._last_tick = -1
        self._reported = 0  # of the rejected messages
        self.rejected: Counter[tuple[str, str]] = Counter()
        self.finished: Control | None = None

    def receive(self, event: Message | Presence, now_ns: int) -> Sequence[Message]:  # noqa: ARG002
        """Take in the roster, measurements and the others' plans."""
        match event:
            case Control():
                self.finished = event
                return ()
            case Roster():
                for plan in self._membership.update(event):
                    self._take(plan)
            case Plan():
                self._take(event)
            case Measurement() if event.tick > self._last_tick and event.uavs == self._uavs:
                self._measurement = event
            case Measurement():
                self.rejected[(event.sender, f"measurement of tick {event.tick} for UAVs {event.uavs}")] += 1
                return ()
            case Presence(name="coordinator", alive=False):
                self.finished = lost(self._out, self._last_tick, "coordinator is gone")
                return ()
            case _:
                return ()
        measurement = self._measurement
        if measurement is None or not self._has_plans_for(measurement):
            return ()
        self._measurement = None
        self._last_tick = measurement.tick
        return self._step(measurement)

    def poll(self, now_ns: int) -> Sequence[Message]:  # noqa: ARG002
        """Nothing happens to an agent by time alone: its time is the measurement."""
        return ()

    def _take(self, plan: Plan) -> None:
        refusal = self._refusal(plan)
        if refusal:
            self.rejected[(plan.sender, refusal)] += 1
        elif refusal is not None:
            self._arrived.setdefault(plan.tick, set()).add(plan.agent)
            ticks = self._links[plan.agent].usable_ticks(plan.tick)
            self._undelivered += [(tick, plan) for tick in ticks]
            if not ticks:
                self._lost.append(plan.tick)

    def _refusal(self, plan: Plan) -> str | None:
        """Why a plan is not believed: a reason, nothing if it is, None if it waits for its roster."""
        if plan.agent not in self._peers:
            return "plan of an unknown agent"
        sender = self._membership.refusal(plan)
        if sender != "":
            return sender
        if plan.uavs != tuple(uav + 1 for uav in self._setup.owned[plan.agent - 1]):
            return "plan for UAVs of somebody else"
        if plan.tick > self._last_tick + 1:
            return "plan from the future"
        return ""

    def _has_plans_for(self, measurement: Measurement) -> bool:
        """Whether the roster is, and the plans of the tick before from whoever sent one and is still on it."""
        if measurement.roster > self._membership.version:
            return False
        senders = set(measurement.answered) & self._membership.agents - {self._agent}
        return senders <= self._arrived.get(measurement.tick - 1, set())

    def _step(self, measurement: Measurement) -> list[Message]:
        watch = [self._stopwatch()]
        k, controller = measurement.tick, self._controller
        period_s = self._setup.settings.sampling_period_s
        steps = self._setup.settings.horizon

        # A plan is usable from the tick its link says, however early it is here; in an order of its own.
        usable = sorted((p for tick, p in self._undelivered if tick <= k), key=lambda p: (p.tick, p.agent))
        self._undelivered = [(tick, plan) for tick, plan in self._undelivered if tick > k]
        self._arrived = {tick: agents for tick, agents in self._arrived.items() if tick >= k}
        for plan in usable:
            self._announced.add(plan)
            self._estimator.take(plan)
        x = self._estimator.estimate(measurement, self._announced)
        if self._setup.scenario.clock.actuation == "immediate":
            start, x0, u0 = k, x, self._in_force(measurement)
        else:
            start, u0 = k + 1, self._announced.at(k, before=k)
            x0, _ = self._setup.model.integrate(x, u0, period_s, _AHEAD_STEPS)
        U = self._announced.sequence(start, steps, before=k)
        y_ref = self._y_ref[start : start + steps + 1]
        law = None
        if controller.gain is not None:
            c = self._announced.corrections(start, steps, before=k)
            law = controller.law(x0, self._x_ref[start : start + steps], c)
        watch.append(self._stopwatch())
        linear = controller.linearise(x0, u0)
        watch.append(self._stopwatch())
        discrete = controller.discretise(linear)
        watch.append(self._stopwatch())
        prediction = controller.predict(linear, discrete, U, law)
        qp = controller.condense(linear, prediction, U, y_ref)
        watch.append(self._stopwatch())
        optimum = controller.conclude(controller.solve(qp), prediction, U, law)
        watch.append(self._stopwatch())

        plan = self._out.stamp(
            Plan,
            tick=k,
            agent=self._agent,
            start_tick=start,
            uavs=self._uavs,
            uav_states=measurement.uav_states,
            inputs=optimum.U,
            corrections=optimum.c,
            status=optimum.solution.status,
        )
        report = self._report(k, usable, optimum, np.diff(watch) / 1e6)
        self._announced.add(plan)
        return [plan, report]

    def _in_force(self, measurement: Measurement) -> Array:
        """Inputs until now: what the own actuators report, and what the others announced."""
        k = measurement.tick
        u = self._announced.at(k - 1, before=k) if k > 0 else self._setup.hover.u.copy()
        u[self._own] = measurement.inputs.reshape(-1)
        return u

    def _planned(self, tick: int) -> Array:
        planned: Array = self._x_ref[tick].copy()
        return planned

    def _report(self, k: int, usable: Sequence[Plan], optimum: Optimum, stages_ms: Array) -> StepReport:
        solution = optimum.solution
        lost = sum(tick < k for tick in self._lost)
        self._lost = [tick for tick in self._lost if tick >= k]
        rejected = self.rejected.total()
        new, self._reported = rejected - self._reported, rejected
        newest = [self._announced.newest(agent, before=k) for agent in self._peers]
        worst = solution.residuals.worst
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
            delivered=len(usable),
            lost=lost,
            late=sum(plan.tick < k - 1 for plan in usable),
            rejected=new,
            times_ms=np.append(stages_ms, stages_ms.sum()),
        )
