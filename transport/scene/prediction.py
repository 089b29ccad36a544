"""Where an agent expects the team to go: the model integrated with the plans it had when it decided."""

import math

import casadi as ca
import numpy as np

from agent.announced import AnnouncedInputs
from model.arrays import Array
from model.compiled import Compiled, functions
from mpc.feedback import FeedbackError
from mpc.regulation import Regulation
from protocol.scenario.setup import Setup
from protocol.wire.messages import Plan, StepReport
from transport.scene.record import Record

# A step of order 5 this long errs by far less than a line is wide.
_STEP_S = 0.05


class Predictor:
    """Predicts what agents predict, with the whole model instead of its linearisation.

    With the shared control law (closed-loop prediction) every agent follows u = u_hover + K (x - x_ref) + feedforward
    + c, with the corrections it has announced; without it, the announced inputs themselves.

    Args:
        setup: The run.
    """

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._steps = setup.settings.horizon
        self._regulation = _regulation(setup)
        self._rollout = Compiled(_rollout(setup, self._regulation))

    def states(self, record: Record, agent: int, tick: int) -> Array | None:
        """The states an agent expected when it made its plan of a tick.

        Args:
            record: What was said.
            agent: 1-based.
            tick: k.
        Returns: At ticks k..k + N_p, (N_p + 1, n); None if the agent made no plan at k, or the team was not whole then.
        Source: docs/equations.md (32), (35).
        """
        own, plant_state = record.plan(agent, tick), record.plant_states.get(tick)
        if own is None or plant_state is None or not record.is_whole(tick):
            return None
        setup, report = self._setup, record.report(agent, tick)
        announced = AnnouncedInputs(
            setup.owned, setup.hover.u, alignment=setup.scenario.controller.received_plans, own=agent
        )
        for plan in [own, *_used(record, report, tick)]:
            announced.add(plan)
        # What acts before the plan starts is decided already.
        waits = min(max(own.start_tick - tick, 0), self._steps)
        U = np.tile(plant_state.u, (self._steps, 1))
        x_ref = np.zeros((self._steps, len(plant_state.x)))
        if self._regulation is None:
            U[waits:] = announced.sequence(own.start_tick, self._steps - waits, tick + 1)
        else:
            c = announced.corrections(tick, self._steps, tick + 1)
            U[:] = setup.hover.u + self._regulation.feedforward(tick, self._steps) + c
            x_ref = setup.X_ref[tick : tick + self._steps]
        forces = np.zeros(3 + 3 * setup.system.N)
        if report is not None:
            forces[:3] = report.force
        ahead = self._rollout(plant_state.x, U.reshape(-1), x_ref.reshape(-1), forces)[0]
        return np.vstack([plant_state.x, ahead.T])


def _used(record: Record, report: StepReport | None, tick: int) -> list[Plan]:
    """The others' plans an agent had, by what it reports."""
    if report is None:
        return []
    ages = zip(report.peers, report.plan_ages, strict=True)
    found = [record.plan(peer, tick - age) for peer, age in ages if age >= 0]
    return [plan for plan in found if plan is not None]


def _regulation(setup: Setup) -> Regulation | None:
    """The shared control law of the whole team; None with open-loop prediction."""
    if setup.settings.prediction != "closed_loop":
        return None
    try:
        return Regulation(setup.model, setup.hover, setup.settings, setup.X_ref)
    except FeedbackError:
        return None


def _rollout(setup: Setup, regulation: Regulation | None) -> ca.Function:
    """(x0, U row by row, x_ref row by row, F) -> states after each sampling period, (n, N_p)."""
    system, settings = setup.system, setup.settings
    n, m, steps = system.n, system.m, settings.horizon
    x, u, x_ref = ca.MX.sym("x", n), ca.MX.sym("u", m), ca.MX.sym("x_ref", n)
    F = ca.MX.sym("F", 3 + 3 * system.N)
    step = functions(system.N)["step"]
    regulator = None if regulation is None else regulation.regulator
    held = u if regulator is None else u + ca.mtimes(ca.DM(regulator.K), x - x_ref)
    lower, upper = settings.limits.lower(system.N), settings.limits.upper(system.N)
    held = ca.fmin(ca.fmax(held, ca.DM(lower)), ca.DM(upper))
    parts = max(1, math.ceil(settings.sampling_period_s / _STEP_S - 1e-9))
    after = x
    for _ in range(parts):
        after = step(after, held, ca.DM(system.vector()), F, settings.sampling_period_s / parts)[0]
    one = ca.Function("one", [x, u, x_ref, F], [after])
    U, X_ref = ca.MX.sym("U", m * steps), ca.MX.sym("X_ref", n * steps)
    ahead = one.mapaccum(steps)(x, ca.reshape(U, m, steps), ca.reshape(X_ref, n, steps), ca.repmat(F, 1, steps))
    return ca.Function("rollout", [x, U, X_ref, F], [ahead])
