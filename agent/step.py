"""One tick's work of an agent: estimate the state, form its problem, solve it, negotiate, conclude.

`Planner` takes what the agent knows at a tick and returns the tick's plan and report. The node decides which messages
count and when a tick may begin.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from agent.estimator import STEPS
from agent.kalman import TOLD, Belief, told
from agent.sharing import Sharing
from agent.team_estimate import Known, TeamEstimate
from model import motors
from model.arrays import Array, ShapeError
from model.discretisation import Discrete
from model.state import input_indices
from mpc.controller import Controller, StepResult
from mpc.feedback import FeedbackLaw
from mpc.prediction import Linear
from mpc.regulation import CostToGo
from protocol.scenario.setup import Setup
from protocol.wire.messages import STAGES, Message, Note, Plan, StepReport
from protocol.wire.node import Outbox

# Stages counted as computation (not waiting or publishing), before the negotiation and in each of its iterations.
_PREPARATION, _ITERATION = ("estimate", "linearise", "discretise"), ("condense", "solve")
# Time between the notes of a Kalman filter, s.
_NOTED_S = 1.0


@dataclass(slots=True, kw_only=True)
class Step:
    """A tick's problem, common to all iterations of the negotiation, and the newest result.

    Attributes:
        known: What the problem was formed from.
        uav_states: Estimated states of the owned UAVs, (owned, 12); with vehicle sensors what they reported.
        start: First tick the plan is for.
        discrete: None if out-of-range states have no discrete model.
        negotiation: Exchanges of plans still to come.
    """

    known: Known
    uav_states: Array
    start: int
    y_ref: Array
    U: Array
    law: FeedbackLaw | None
    end: CostToGo | None
    linear: Linear
    discrete: Discrete | None
    negotiation: int
    result: StepResult | None = None
    times_ns: dict[str, int] = field(default_factory=lambda: dict.fromkeys(STAGES, 0))


class Planner:
    """Estimator and controller of one agent, 1-based; the stopwatch counts ns of a steady clock."""

    def __init__(self, setup: Setup, agent: int, stopwatch: Callable[[], int]) -> None:
        self._setup, self._agent, self._stopwatch = setup, agent, stopwatch
        self._owned = setup.owned[agent - 1]
        self._own_inputs = input_indices(self._owned)
        self._controller = Controller(
            setup.model, setup.hover, setup.settings, self._owned, setup.X_ref, setup.track, setup.obstacles
        )
        self._team = TeamEstimate(setup, agent, self._controller)
        self._reset_sharing()

    def restart(self) -> None:
        """Reset for a new start in the run; the controller keeps its state."""
        self._team.restart()
        self._reset_sharing()

    def head(self, setup: Setup) -> None:
        """Follow the reference of the run with a further target, from that target's tick on."""
        self._setup = setup
        self._team.head(setup)

    def _reset_sharing(self) -> None:
        settings, uavs = self._setup.settings, len(self._owned)
        self._sharing = Sharing(self._setup.scenario.controller, settings.lower(uavs), settings.upper(uavs))
        self._idle_since_ns = self._stopwatch()

    @property
    def belief(self) -> Belief | None:
        """Newest belief of the Kalman filter; None without one."""
        return self._team.estimator.belief

    def warm_up(self) -> None:
        """Compute a step and discard it, so that the first step of the run is not slower than the others."""
        controller, hover = self._controller, self._setup.hover
        forces = self._team.forces
        U = np.tile(hover.u, (self._setup.settings.horizon, 1))
        lag_s = self._setup.settings.motor_lag_s
        x0 = np.concatenate([hover.x, hover.u]) if lag_s > 0.0 else hover.x
        law = controller.law(x0, np.tile(hover.x, (len(U), 1)), np.zeros_like(U), forces)
        y_ref = np.tile(self._setup.model.outputs(hover.x), (len(U) + 1, 1))
        end = controller.end(x0, hover.x, forces)
        controller.step(x0, hover.u, U, y_ref, law, forces, end=end)
        motors.integrate(self._setup.model, x0, hover.u, self._setup.settings.sampling_period_s, STEPS, lag_s)

    def begin(self, known: Known) -> Step:
        """Estimate the state at a tick and form the problem that follows from it."""
        watch = [known.started_ns]
        k, controller, setup, team = known.measurement.tick, self._controller, self._setup, self._team
        period_s, steps = setup.settings.sampling_period_s, setup.settings.horizon
        x = team.update(known)
        forces, announced = team.forces, team.announced
        if setup.scenario.clock.next_tick:
            start, u0 = k + 1, announced.at(k, before=k, x=x)
            x0, _ = motors.integrate(controller.model, x, u0, period_s, STEPS, setup.settings.motor_lag_s, forces)
        else:
            start, x0, u0 = k, x, team.inputs_until(k)
        U = announced.sequence(start, steps, before=k)
        c = announced.corrections(start, steps, before=k)
        law = controller.law(x0, setup.X_ref[start : start + steps], c, forces, start)
        end = controller.end(x0, setup.X_ref[start + steps], forces, start + steps)
        watch.append(self._stopwatch())
        linear = controller.linearise(x0, u0, forces)
        watch.append(self._stopwatch())
        try:
            discrete = controller.discretise(linear)
        except ShapeError:
            discrete = None
        outdated = announced.under_previous_law(before=k)
        if law is not None and discrete is not None and outdated:
            columns = np.concatenate([input_indices(setup.owned[agent - 1]) for agent in outdated])
            law = controller.adapted(law, linear, discrete, U, columns)
        watch.append(self._stopwatch())
        step = Step(
            known=known,
            uav_states=team.reported(k, x),
            start=start,
            y_ref=setup.Y_ref[start : start + steps + 1],
            U=U,
            law=law,
            end=end,
            linear=linear,
            discrete=discrete,
            negotiation=setup.scenario.controller.negotiation_iterations,
        )
        step.times_ns["wait"] = watch[0] - self._idle_since_ns
        for stage, (begun, done) in zip(_PREPARATION, pairwise(watch), strict=True):
            step.times_ns[stage] = done - begun
        return step

    def plan(self, step: Step, out: Outbox, publish_ns: int) -> list[Message]:
        """Solve a step's problem and return a proposal to the others, or at the end the tick's plan and report.

        The step's `negotiation` counts down to 0; the last step's messages took `publish_ns` to publish.
        """
        result = step.result = self._solved(step)
        step.negotiation -= 1
        k, roster = step.known.measurement.tick, step.known.measurement.roster
        plan = out.stamp(
            Plan,
            tick=k,
            agent=self._agent,
            start_tick=step.start,
            uavs=tuple(uav + 1 for uav in self._owned),
            uav_states=step.uav_states,
            inputs=result.U,
            corrections=result.c,
            status=result.solution.status,
            negotiation=step.negotiation,
            shared=step.negotiation > 0 or self._sharing.decide(k, step.start, result.c, roster),
        )
        if step.negotiation > 0:
            return [plan]
        self._team.announced.add(plan)
        step.times_ns["publish"] = publish_ns
        step.times_ns["total"] = sum(step.times_ns[stage] for stage in (*_PREPARATION, *_ITERATION))
        report = self._report(step, result, out)
        notes = self._notes(k, out)
        self._idle_since_ns = self._stopwatch()
        return [*notes, plan, report]

    def end(self, tick: int, out: Outbox) -> list[Message]:  # noqa: ARG002
        """Return nothing: this controller has nothing to end with the run."""
        return []

    def adopt(self, step: Step, proposals: Sequence[Plan]) -> None:
        """Take the others' proposals and the own one into the next iteration of the negotiation."""
        U, c = step.U.copy(), None if step.law is None else step.law.c.copy()
        known: list[tuple[npt.NDArray[np.intp], Array, Array]] = [
            (input_indices(self._setup.owned[plan.agent - 1]), plan.inputs, plan.corrections) for plan in proposals
        ]
        if step.result is not None:
            known.append((self._own_inputs, step.result.U, step.result.c))
        for columns, inputs, corrections in known:
            if len(inputs) == len(U):
                U[:, columns] = inputs
            if c is not None and len(corrections) == len(c):
                c[:, columns] = corrections
        step.U = U
        if step.law is not None and c is not None:
            step.law = replace(step.law, c=c)

    def _solved(self, step: Step) -> StepResult:
        """Predict, condense, solve and conclude."""
        controller = self._controller
        watch = [self._stopwatch()]
        if step.discrete is None:
            result = controller.give_up(step.U, step.law)
            watch += [self._stopwatch(), self._stopwatch()]
        else:
            with np.errstate(over="ignore", invalid="ignore"):
                prediction = controller.predict(step.linear, step.discrete, step.U, step.law)
                qp = controller.condense(step.linear, prediction, step.y_ref, step.law, step.end)
                watch.append(self._stopwatch())
                solution = controller.solve(qp)
                result = controller.conclude(solution, prediction, step.U, step.law, step.known.ticks_since_start)
                watch.append(self._stopwatch())
                if step.law is not None:
                    self._team.expect(step.start, prediction, result.U)
        for stage, (begun, done) in zip(_ITERATION, pairwise(watch), strict=True):
            step.times_ns[stage] += done - begun
        return result

    def _notes(self, k: int, out: Outbox) -> list[Message]:
        """Return what a Kalman filter knows of the payload, once in a while: the covariance of each tick is work."""
        if self.belief is None or k == 0 or k % max(1, round(_NOTED_S / self._setup.settings.sampling_period_s)):
            return []
        return [out.stamp(Note, tick=k, agent=self._agent, problem="", names=TOLD, values=told(self.belief))]

    def _report(self, step: Step, result: StepResult, out: Outbox) -> StepReport:
        k, solution, team = step.known.measurement.tick, result.solution, self._team
        newest = [team.announced.newest(agent, before=k) for agent in team.peers]
        worst, measured = solution.residuals.worst, team.estimator.measured
        return step_report(
            step.known,
            self._agent,
            out,
            status=solution.status,
            solver=solution.solver,
            fallback=solution.fallback,
            iterations=solution.iterations,
            residual=worst if np.isfinite(worst) else -1.0,
            peers=team.peers,
            plan_ages=tuple(-1 if plan is None else k - plan.tick for plan in newest),
            state_ages=tuple(team.estimator.age(agent, k) for agent in team.peers),
            measurement_age=-1 if measured < 0 else k - measured,
            force=np.zeros(3) if team.forces is None else self._controller.model.at_rest(team.forces)[:3],
            times_ns=step.times_ns,
        )


_WITHOUT_SOLVER: Mapping[str, Any] = {"fallback": False, "iterations": 0, "residual": -1.0, "force": np.zeros(3)}


def step_report(known: Known, agent: int, out: Outbox, *, times_ns: Mapping[str, int], **fields: Any) -> StepReport:
    """Return the report of a step from what the agent, 1-based, knew, and the other fields of the message.

    Fields that describe a solver are those of a step without one, unless they are given.
    """
    return out.stamp(
        StepReport,
        tick=known.measurement.tick,
        agent=agent,
        delivered=len(known.plans),
        lost=known.lost,
        late=sum(plan.tick < known.measurement.tick - 1 for plan in known.plans),
        times_ms=np.array([times_ns[stage] / 1e6 for stage in STAGES]),
        **{**_WITHOUT_SOLVER, **fields},
    )
