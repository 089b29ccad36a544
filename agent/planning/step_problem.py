"""The problem of an agent at a tick: begin of the horizon, announced inputs, law, cost behind, linear model."""

import msgspec

from transport.agent.estimation.predicted_motion import STEPS
from transport.agent.estimation.team_estimate import TeamEstimate
from transport.agent.planning.step_report import StageTimes
from transport.model.arrays import Array, ShapeError
from transport.model.linear import motor_lag as motors
from transport.model.linear.discretisation import Discrete
from transport.model.linear.linearisation import Model
from transport.mpc.controller import Controller
from transport.mpc.program.feedback_law import FeedbackLaw
from transport.mpc.program.horizon_and_terminal_cost import CostToGo
from transport.mpc.program.prediction import Linear
from transport.mpc.settings_period_horizon_weights import ControllerSettings
from transport.protocol.scenario.setup.team_run import TeamRun


class HorizonStart(msgspec.Struct, frozen=True, kw_only=True):
    """Begin of the horizon."""

    tick: int  # first tick that the plan is for
    x0: Array  # state there, (n,), with motor lag (n + m,)
    u0: Array  # inputs in force just before, (m,)


class StepProblem(msgspec.Struct, frozen=True, kw_only=True):
    """Problem of an agent at a tick: the same in all iterations but for the announced plans."""

    y_ref: Array  # reference outputs at steps 0..N_p, (N_p + 1, p)
    # Announced inputs of all UAVs, (N_p, m), with a law the own ones alone; the owned columns hold the
    # previous plan.
    U: Array
    law: FeedbackLaw | None  # shared control law with the announced corrections
    end: CostToGo | None  # cost after the horizon
    linear: Linear
    discrete: Discrete | None  # None if out-of-range states have no discrete model


def horizon_start(
    setup: TeamRun, controller: Controller, team: TeamEstimate, k: int, x: Array
) -> HorizonStart:
    """Return the begin of the horizon: the tick k of an estimate x, or one later by prediction."""
    announced = team.announced
    if not setup.rules.clock.next_tick:
        return HorizonStart(tick=k, x0=x, u0=team.estimator.inputs_until(k, announced))
    u0 = announced.in_force(k, before=k, x=x)
    x0 = integrated(setup.settings, controller.model, x, u0, team.forces)
    return HorizonStart(tick=k + 1, x0=x0, u0=u0)


def integrated(
    settings: ControllerSettings, model: Model, x: Array, u: Array, forces: Array | None
) -> Array:
    """Return the state one sampling period later under constant inputs."""
    period = motors.Period(
        duration_s=settings.sampling_period_s, steps=STEPS, lag_s=settings.motor_lag_s
    )
    return motors.integrate(model, x, u, period, forces)


def step_problem(
    setup: TeamRun,
    controller: Controller,
    team: TeamEstimate,
    start: HorizonStart,
    k: int,
    times: StageTimes,
) -> StepProblem:
    """Return the problem of tick k, about the begin of its horizon; the times count its stages."""
    forces = team.forces
    announced = team.announced
    steps = setup.settings.horizon
    first = start.tick

    # u(j) = u_hov + K (x(j) - x_ref(j)) + c_ff(j) + c(j): (35), along a flat reference (71).
    law = None
    if setup.settings.prediction == "closed_loop":
        c = announced.corrections(first, steps, before=k)
        law = controller.law(start.x0, setup.X_ref[first : first + steps], c, forces, first)

    # U(j) = U_a(min(s + j - s_a, N_p - 1)), each agent's newest plan shifted by its age: (32).
    # With the law the own ones alone count, after a step without solution.
    U = announced.sequence(first, steps, before=k, of_all=law is None)

    # The cost of all later steps under that law: (36d).
    end = controller.end(start.x0, setup.X_ref[first + steps], forces, first + steps)
    times.lap("estimate")

    # dx' = A_c dx + B_c du + f(x0, u0): (15).
    linear = controller.linearise(start.x0, start.u0, forces)
    times.lap("linearise")

    # dx(j + 1) = A dx(j) + B du(j) + f_d: (16), (17).
    discrete = _discrete(controller, linear)
    times.lap("discretise")
    y_ref = setup.Y_ref[first : first + steps + 1]
    return StepProblem(y_ref=y_ref, U=U, law=law, end=end, linear=linear, discrete=discrete)


def _discrete(controller: Controller, linear: Linear) -> Discrete | None:
    """Return the difference equation; None if out-of-range states have none."""
    try:
        return controller.discretise(linear)
    except ShapeError:
        return None
