"""Predicted states of the team as an agent saw them: the model integrated with the plans the agent had."""

import math
from copy import copy

import casadi as ca
import numpy as np

from agent.announced import AnnouncedInputs
from model import motors
from model.arrays import Array
from model.compiled import Compiled, functions
from model.factors import rate_places
from mpc.feedback import FeedbackError
from mpc.regulation import Ahead, Regulation
from mpc.tracking import rollout
from protocol.scenario.setup import Setup
from transport.scene.history import RunHistory

# Longest integration step, s; at order 5 its error is far below the width of a line.
_STEP_S = 0.05
# Share of an earlier command at which its effect on the actual inputs has decayed.
_FORGOTTEN = 1e-6


class Predictor:
    """Predictions of agents, computed with the nonlinear model instead of its linearisation.

    With closed-loop prediction every agent applies u = u_hover + K (x - x_ref) + feedforward + c with its announced
    corrections c; with open-loop prediction it applies its announced inputs.
    """

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._steps = setup.settings.horizon
        self._regulation = _regulation(setup)
        self._newest: tuple[Ahead, Regulation] | None = None
        self._rollout = Compiled(_rollout(setup, self._regulation))

    def states(self, history: RunHistory, agent: int, tick: int) -> Array | None:
        """Return the states an agent predicted with its plan of a tick, k.

        Returns: States at ticks k..k + N_p, (N_p + 1, n); None if the agent made no plan at k, or an agent or UAV was
            off the roster.
        Source: docs/equations.md (32), (35).
        """
        own, plant_state = history.plan(agent, tick), history.plant_states.get(tick)
        if own is None or plant_state is None or not history.is_whole(tick):
            return None
        setup, report = history.setup_at(tick), history.report(agent, tick)
        regulation = self._following(setup)
        announced = AnnouncedInputs(
            setup.owned, setup.hover.u, alignment=setup.scenario.controller.received_plans, own=agent
        )
        announced.add(own)
        for peer, age in () if report is None else zip(report.peers, report.plan_ages, strict=True):
            used = history.plan(peer, tick - age) if age >= 0 else None
            if used is not None:
                announced.add(used)
        # Inputs before the start of the plan are already fixed.
        first = min(max(own.start_tick - tick, 0), self._steps)
        U = np.tile(plant_state.u, (self._steps, 1))
        x_ref = np.zeros((self._steps, len(plant_state.x)))
        if regulation is None:
            U[first:] = announced.sequence(own.start_tick, self._steps - first, tick + 1)
        else:
            c = announced.corrections(tick, self._steps, tick + 1)
            U[:] = setup.hover.u + regulation.feedforward(tick, self._steps) + c
            x_ref = setup.X_ref[tick : tick + self._steps]
        forces = np.zeros(3 + 3 * setup.system.N)
        if report is not None:
            forces[:3] = report.force
        if regulation is not None and setup.track is not None:
            law = regulation.law(plant_state.x, x_ref, c, forces, tick)
            if law is not None:
                return rollout(setup.model, setup.settings, plant_state.x, law, forces)[0]
        start = plant_state.x
        if setup.settings.motor_lag_s > 0.0:
            start = np.concatenate([start, self._actual(history, tick)])
        ahead = self._rollout(start, U.reshape(-1), x_ref.reshape(-1), forces)[0]
        return np.vstack([plant_state.x, ahead.T[:, : len(plant_state.x)]])

    def _following(self, setup: Setup) -> Regulation | None:
        """Return the shared control law with the targets of a run."""
        if self._regulation is None or setup.ahead is None:
            return self._regulation
        if self._newest is None or self._newest[0] is not setup.ahead:
            found = copy(self._regulation)
            found.head(setup.X_ref, setup.ahead)
            self._newest = setup.ahead, found
        return self._newest[1]

    def _actual(self, history: RunHistory, tick: int) -> Array:
        """Return the actual inputs at a tick as its agents estimate them: by the lag from the commands before, (m,)."""
        settings = self._setup.settings
        lag_s, period_s = settings.motor_lag_s, settings.sampling_period_s
        forgotten_s = lag_s * math.log(1.0 / _FORGOTTEN)
        left = _shares(self._setup, period_s)[2]
        a: Array = self._setup.hover.u
        for k in range(max(0, tick - math.ceil(forgotten_s / period_s)), tick):
            before = history.plant_states.get(k)
            if before is not None:
                a = before.u + left[0] * (a - before.u) + left[1] * (motors.commanded_states(before.x) - before.u)
        return a


def _regulation(setup: Setup) -> Regulation | None:
    """Return the shared control law of the team; None with open-loop prediction or a controller of the user."""
    if setup.settings.prediction != "closed_loop" or setup.scenario.agents.controller != "mpc":
        return None
    try:
        return Regulation(setup.model, setup.hover, setup.settings, setup.X_ref, setup.track)
    except FeedbackError:
        return None


def _shares(setup: Setup, step_s: float) -> Array:
    """Return what is left of deviations from commands over a step, (3, 2, m); see `motors.shares`."""
    gains = setup.system.rate_gains
    return motors.shares(
        setup.settings.motor_lag_s, step_s, None if gains is None else tuple(gains.tolist()), setup.system.N
    )


def _rollout(setup: Setup, regulation: Regulation | None) -> ca.Function:
    """Return (x0, U row by row, x_ref row by row, F) -> states after each sampling period, (n, N_p).

    With motor lag x0 and the states are [x, actual inputs], (n + m,).
    """
    system, settings = setup.system, setup.settings
    n, m, steps = system.n, system.m, settings.horizon
    lag_s = settings.motor_lag_s
    z = ca.MX.sym("z", n + m if lag_s > 0.0 else n)
    u, x_ref = ca.MX.sym("u", m), ca.MX.sym("x_ref", n)
    F = ca.MX.sym("F", 3 + 3 * system.N)
    step = functions(system.N, system.commands_rates)["step"]
    regulator = None if regulation is None else regulation.regulator
    error = ca.vertcat(z[:n] - x_ref, z[n:] - ca.DM(setup.hover.u)) if lag_s > 0.0 else z - x_ref
    held = u if regulator is None else u + ca.mtimes(ca.DM(regulator.K), error)
    lower, upper = settings.lower(system.N), settings.upper(system.N)
    held = ca.fmin(ca.fmax(held, ca.DM(lower)), ca.DM(upper))
    parts = max(1, math.ceil(settings.sampling_period_s / _STEP_S - 1e-9))
    p, step_s, after, a = ca.DM(system.vector()), settings.sampling_period_s / parts, z[:n], z[n:]
    for _ in range(parts):
        if lag_s > 0.0:
            inputs, states = rate_places(m)
            moving = ca.MX.zeros(m)
            moving[inputs.tolist()] = after[states.tolist()]
            first, second, a = (
                held + ca.DM(of[0]) * (a - held) + ca.DM(of[1]) * (moving - held) for of in _shares(setup, step_s)
            )
            for half in (first, second):
                after = step(after, half, p, F, step_s / 2.0)[0]
        else:
            after = step(after, held, p, F, step_s)[0]
    one = ca.Function("one", [z, u, x_ref, F], [ca.vertcat(after, a) if lag_s > 0.0 else after])
    U, X_ref = ca.MX.sym("U", m * steps), ca.MX.sym("X_ref", n * steps)
    ahead = one.mapaccum(steps)(z, ca.reshape(U, m, steps), ca.reshape(X_ref, n, steps), ca.repmat(F, 1, steps))
    return ca.Function("rollout", [z, U, X_ref, F], [ahead])
