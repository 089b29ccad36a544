"""One tick's work of an agent: estimate the state, form its problem, solve it, negotiate, conclude."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from agent.estimator import STEPS
from agent.handover_inputs import HandOver
from agent.kalman import TOLD, Belief
from agent.team_estimate import Known, TeamEstimate
from model import motors
from model.arrays import Array, ShapeError
from model.discretisation import Discrete
from model.state import input_indices
from mpc.controller import Controller, StepResult
from mpc.feedback import FeedbackLaw
from mpc.prediction import Linear
from mpc.regulation import CostToGo
from protocol.scenario.schema import ControllerSection
from protocol.scenario.setup import Setup
from protocol.wire.messages import STAGES, Message, Note, Plan, StepReport
from protocol.wire.node import Outbox

# Stages counted as computation, not waiting or publishing.
_COMPUTATION = ("estimate", "linearise", "discretise", "condense", "solve")
# Time between the notes of a Kalman filter, s.
_NOTED_S = 1.0


@dataclass(slots=True, kw_only=True)
class Step:
    """A tick's problem, common to all iterations of the negotiation, and the newest result."""

    known: Known  # what it was formed from
    uav_states: Array  # estimates of the owned UAVs, (owned, 12); with vehicle sensors what they reported
    start: int  # first tick the plan is for
    y_ref: Array
    U: Array
    law: FeedbackLaw | None
    end: CostToGo | None
    linear: Linear
    discrete: Discrete | None  # None if out-of-range states have no discrete model
    negotiation: int  # exchanges of plans still to come
    times_ns: dict[str, int]
    result: StepResult | None = None


class Sharing:
    """Event-triggered sharing of plans; smallest and largest inputs of the agent's UAVs, (4 owned,), are its scale.

    With closed-loop prediction the others know the shared control law, but not the agent's corrections to it. They
    assume the last shared corrections, shifted to the present tick and zero after their end.
    """

    def __init__(self, settings: ControllerSection, lower: Array, upper: Array) -> None:
        self._always, self._threshold = settings.share == "always", settings.share_threshold
        # At least one tick; rounding must not take one from a whole number of periods.
        self._heartbeat = max(1, math.floor(settings.share_heartbeat_s / settings.sampling_period_s + 1e-9))
        self._span = upper - lower
        self._shared: tuple[int, int, Array, int] | None = None  # arguments of the last plan that was shared

    def decide(self, tick: int, start: int, c: Array, roster: int) -> bool:
        """Decide whether to share a plan; the others assume a shared plan from then on.

        Shared are the first plan, the first one under each roster (control law or receivers may be new), one that is a
        heartbeat newer than the last shared one, and one whose corrections c to the shared control law, (N_p, 4 owned),
        from tick `start` on, have changed by more than the threshold of the inputs' range.
        Source: docs/equations.md (49).
        """
        if self._shared is not None and not self._always:
            before, begun, corrections, version = self._shared
            assumed = np.zeros_like(c)
            left = corrections[start - begun :][: len(c)]
            assumed[: len(left)] = left
            change = np.max(np.abs(c - assumed) / self._span, initial=0.0)
            if roster == version and tick - before < self._heartbeat and change <= self._threshold:
                return False
        self._shared = tick, start, c, roster
        return True


class Planner:
    """Estimator and controller of one agent, 1-based; the stopwatch counts ns of a steady clock."""

    def __init__(self, setup: Setup, agent: int, stopwatch: Callable[[], int]) -> None:
        self._setup, self._agent, self._stopwatch = setup, agent, stopwatch
        self._owned = setup.owned[agent - 1]
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
        self._handover = HandOver(self._setup, self._team, self._owned)
        self._reset_at = set[int]()  # ticks at which the filter began anew, as far as noted
        self._lapped_ns = self._stopwatch()  # end of the last stage

    @property
    def belief(self) -> Belief | None:
        """Newest belief of the Kalman filter; None without one."""
        return self._team.estimator.belief

    def warm_up(self) -> None:
        """Compute a step and discard it, so that the first step of the run is not slower than the others."""
        controller, hover, settings = self._controller, self._setup.hover, self._setup.settings
        forces = self._team.forces
        U = np.tile(hover.u, (settings.horizon, 1))
        x0 = np.concatenate([hover.x, hover.u]) if settings.motor_lag_s > 0.0 else hover.x
        law = controller.law(x0, np.tile(hover.x, (len(U), 1)), np.zeros_like(U), forces)
        y_ref = np.tile(self._setup.model.outputs(hover.x), (len(U) + 1, 1))
        controller.step(x0, hover.u, U, y_ref, law, forces, end=controller.end(x0, hover.x, forces))
        motors.integrate(self._setup.model, x0, hover.u, settings.sampling_period_s, STEPS, settings.motor_lag_s)

    def begin(self, known: Known) -> Step:
        """Estimate the state at a tick and form the problem that follows from it."""
        times_ns = dict.fromkeys(STAGES, 0)
        times_ns["wait"], self._lapped_ns = known.started_ns - self._lapped_ns, known.started_ns
        k, controller, setup, team = known.measurement.tick, self._controller, self._setup, self._team
        period_s, steps = setup.settings.sampling_period_s, setup.settings.horizon
        x = team.update(known)
        forces, announced = team.forces, team.announced
        if setup.scenario.clock.next_tick:
            start, u0 = k + 1, announced.at(k, before=k, x=x)
            x0, _ = motors.integrate(controller.model, x, u0, period_s, STEPS, setup.settings.motor_lag_s, forces)
        else:
            start, x0, u0 = k, x, team.estimator.inputs_until(k, announced)
        U = announced.sequence(start, steps, before=k)
        c = announced.corrections(start, steps, before=k)
        law = controller.law(x0, setup.X_ref[start : start + steps], c, forces, start)
        end = controller.end(x0, setup.X_ref[start + steps], forces, start + steps)
        self._lap(times_ns, "estimate")
        linear = controller.linearise(x0, u0, forces)
        self._lap(times_ns, "linearise")
        try:
            discrete = controller.discretise(linear)
        except ShapeError:
            discrete = None
        outdated = announced.under_previous_law(before=k)
        if law is not None and discrete is not None and outdated:
            columns = np.concatenate([input_indices(setup.owned[agent - 1]) for agent in outdated])
            law = controller.adapted(law, linear, discrete, U, columns)
        self._lap(times_ns, "discretise")
        return Step(
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
            times_ns=times_ns,
        )

    def plan(self, step: Step, out: Outbox, publish_ns: int) -> list[Message]:
        """Solve a step's problem and return a proposal to the others, or at the end the tick's plan and report.

        The step's `negotiation` counts down to 0; the last step's messages took `publish_ns` to publish.
        """
        result = step.result = self._solved(step)
        step.negotiation -= 1
        if step.negotiation == 0:
            result = self._handed_over(step, result)
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
            alone=self._handover.share,
        )
        if step.negotiation > 0:
            return [plan]
        self._team.announced.add(plan)
        step.times_ns["publish"] = publish_ns
        step.times_ns["total"] = sum(step.times_ns[stage] for stage in _COMPUTATION)
        report = self._report(step, result, out)
        notes = self._notes(k, out)
        self._lapped_ns = self._stopwatch()
        return [*notes, plan, report]

    def end(self, tick: int, out: Outbox) -> list[Message]:  # noqa: ARG002
        """Return nothing: this controller has nothing to end with the run."""
        return []

    def adopt(self, step: Step, proposals: Sequence[Plan]) -> None:
        """Take the others' proposals and the own one into the next iteration of the negotiation."""
        U, law = step.U.copy(), step.law and replace(step.law, c=step.law.c.copy())
        known = [(plan.agent, plan.inputs, plan.corrections) for plan in proposals]
        if step.result is not None:
            known.append((self._agent, step.result.U, step.result.c))
        for agent, inputs, corrections in known:
            columns = input_indices(self._setup.owned[agent - 1])
            if len(inputs) == len(U):
                U[:, columns] = inputs
            if law is not None and len(corrections) == len(law.c):
                law.c[:, columns] = corrections
        step.U, step.law = U, law

    def _lap(self, times_ns: dict[str, int], stage: str) -> None:
        """Count the time since the end of the last stage as that of a stage."""
        before_ns, self._lapped_ns = self._lapped_ns, self._stopwatch()
        times_ns[stage] += self._lapped_ns - before_ns

    def _solved(self, step: Step) -> StepResult:
        """Predict, condense, solve and conclude."""
        controller = self._controller
        self._lapped_ns = self._stopwatch()
        if step.discrete is None:
            result = controller.give_up(step.U, step.law)
            self._lap(step.times_ns, "condense")
            return result
        with np.errstate(over="ignore", invalid="ignore"):
            prediction = controller.predict(step.linear, step.discrete, step.U, step.law)
            qp = controller.condense(step.linear, prediction, step.y_ref, step.law, step.end)
            self._lap(step.times_ns, "condense")
            solution = controller.solve(qp)
            result = controller.conclude(solution, prediction, step.U, step.law, step.known.ticks_since_start)
            self._lap(step.times_ns, "solve")
            if step.law is not None:
                self._team.expected = step.start, prediction, result.U
        return result

    def _notes(self, k: int, out: Outbox) -> list[Message]:
        """Return what a Kalman filter knows of the payload, once in a while, and whether it began anew."""
        estimator, notes = self._team.estimator, list[Message]()
        every = max(1, round(_NOTED_S / self._setup.settings.sampling_period_s))
        # The covariance of each tick is work.
        numbers = estimator.told_of_payload() if self.belief is not None and k > 0 and k % every == 0 else None
        if numbers is not None:
            notes.append(out.stamp(Note, tick=k, agent=self._agent, problem="", names=TOLD, values=numbers))
        if new := sorted(estimator.resets - self._reset_at):
            self._reset_at |= set(new)
            problem = f"filter: estimate out of range, begun anew about the reference at tick {new[-1]}"
            notes.append(out.stamp(Note, tick=k, agent=self._agent, problem=problem, names=(), values=np.zeros(0)))
        return notes

    def _handed_over(self, step: Step, result: StepResult) -> StepResult:
        """Return the result with inputs between those of the team and those of the UAVs alone, as news are overdue."""
        return replace(result, U=self._handover.inputs(step.known.measurement.tick, step.start, step.linear, result.U))

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


def step_report(known: Known, agent: int, out: Outbox, *, times_ns: Mapping[str, int], **fields: Any) -> StepReport:
    """Return the report of a step of an agent, 1-based, from what it knew, the times of stages, and other fields."""
    return out.stamp(
        StepReport,
        tick=known.measurement.tick,
        agent=agent,
        delivered=len(known.plans),
        lost=known.lost,
        late=sum(plan.tick < known.measurement.tick - 1 for plan in known.plans),
        times_ms=np.array([times_ns[stage] / 1e6 for stage in STAGES]),
        **fields,
    )
