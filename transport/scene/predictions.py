"""Paths that the agents predicted at a tick, computed again from the recorded plans.

Every agent predicts the whole team over its horizon from its own plan and the plans that it used of
the others, as far as its step report names them. Here the prediction begins at the true state of
the plant, which an agent only estimates, and all agents follow the team's law: one that acts alone
does not fly its path.
"""

from typing import NamedTuple

import numpy as np

from transport.agent.communication.announced_inputs import AnnouncedInputs
from transport.model.arrays import Array
from transport.model.state import StateView
from transport.mpc.law.present_law import Regulation
from transport.mpc.program.feedback_law import FeedbackLaw
from transport.mpc.program.rollout import Actuation, rollout
from transport.mpc.reference import Sampled
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Plan, PlantState, StepReport
from transport.scene.history import RunHistory


class PredictedPaths(NamedTuple):
    """Paths that one agent predicts over its horizon of N_p steps, inertial frame, m."""

    agent: int  # 1-based
    uavs_I: Array  # its own UAVs, (N_p + 1, owned, 3)
    payload_I: Array  # (N_p + 1, 3)


class Predictions:
    """Predictions of all agents of one run, whose history may grow."""

    def __init__(self, history: RunHistory) -> None:
        self._history = history
        self._regulation: Regulation | None = None
        self._followed: Sampled | None = None  # the reference that it follows

    @property
    def _setup(self) -> Setup:
        """The run, with its targets so far."""
        return self._history.setup

    def paths(self, tick: int) -> tuple[PredictedPaths, ...]:
        """Return the paths of the agents that made a plan at a tick; its plant state must be recorded."""
        setup = self._setup
        positions = 3 * setup.system.N
        predicted = []
        for agent, owned in zip(setup.agents, setup.owned, strict=True):
            states = self._states(agent, tick)
            if states is None or not np.isfinite(states).all():
                continue

            y = np.array([setup.model.outputs(x) for x in states])
            team_I = y[:, :positions].reshape(len(y), -1, 3)
            payload_I = StateView(states).r0_I
            predicted.append(PredictedPaths(agent, team_I[:, list(owned)], payload_I))
        return tuple(predicted)

    def _states(self, agent: int, tick: int) -> Array | None:
        """Return the states that an agent predicted with its plan of a tick, (N_p + 1, n).

        None without a plan of that tick, and while an agent or UAV is off the roster.
        Source: docs/equations.md (32), (35).
        """
        plan = self._history.plans.get((agent, tick))
        if plan is None or not self._is_team_complete(tick):
            return None

        setup = self._setup
        plant_state = self._history.plant_states[tick]
        report = self._history.reports.get((agent, tick))
        announced = self._announced(plan, report, tick)

        # Estimated force on the payload; the other entries are the UAVs', which no report tells.
        forces = np.zeros(3 + 3 * setup.system.N)
        if report is not None:
            forces[:3] = report.force

        z0 = plant_state.x
        if setup.settings.motor_lag_s > 0.0:
            z0 = np.concatenate([plant_state.x, plant_state.u])  # as if motors reached them at once

        law = self._team_law(z0, announced, forces, plan)
        if law is None:
            law = self._open_loop(z0, announced, plan, plant_state)
        actuation = Actuation.of(setup.settings, setup.system.N)
        predicted = rollout(setup.model, actuation, z0, law, forces)
        return predicted.Z[:, : len(plant_state.x)]

    def _is_team_complete(self, tick: int) -> bool:
        """Return whether all agents and UAVs are on the roster of a tick, or none is known."""
        roster = self._history.roster(tick)
        if roster is None:
            return True
        return set(roster.agents) == set(self._setup.agents) and not roster.off

    def _announced(self, plan: Plan, report: StepReport | None, tick: int) -> AnnouncedInputs:
        """Return the inputs of an agent's plan and of the others' plans that it used.

        No fail-safe is set: of a complete team no agent has left.
        """
        setup = self._setup
        alignment = setup.scenario.controller.received_plans
        announced = AnnouncedInputs(setup.owned, setup.hover.u, alignment=alignment, own=plan.agent)
        announced.add(plan)
        # With a plan that starts at the next tick the one before is still in force.
        before = self._history.plans.get((plan.agent, tick - 1))
        if before is not None:
            announced.add(before)
        if report is None:
            return announced

        for peer, age in zip(report.peers, report.plan_ages, strict=True):
            used = self._history.plans.get((peer, tick - age)) if age >= 0 else None
            if used is not None:
                announced.add(used)
        return announced

    def _team_law(
        self, z0: Array, announced: AnnouncedInputs, forces: Array, plan: Plan
    ) -> FeedbackLaw | None:
        """Return the shared control law with the announced corrections; None if there is none."""
        regulation = self._followed_regulation()
        if regulation is None:
            return None

        steps = self._setup.settings.horizon
        tick = plan.tick
        x_ref = self._setup.X_ref[tick : tick + steps]
        # Until the plan starts, the corrections are those of the plans before it.
        fixed = min(max(plan.start_tick - tick, 0), steps)
        first = announced.corrections(tick, fixed, before=tick)
        later = announced.corrections(plan.start_tick, steps - fixed, before=tick + 1)
        corrections = np.concatenate([first, later])
        return regulation.law(z0, x_ref, corrections, forces, tick)

    def _open_loop(
        self, z0: Array, announced: AnnouncedInputs, plan: Plan, plant_state: PlantState
    ) -> FeedbackLaw:
        """Return the announced inputs as a law without feedback."""
        steps = self._setup.settings.horizon
        tick = plan.tick
        # Inputs before the start of the plan are already fixed.
        fixed = min(max(plan.start_tick - tick, 0), steps)
        U = np.tile(plant_state.u, (steps, 1))
        U[fixed:] = announced.sequence(plan.start_tick, steps - fixed, before=tick + 1)

        return FeedbackLaw(
            K=np.zeros((U.shape[1], len(z0))),
            u_rest=U,
            error=np.zeros((steps, len(z0))),
            feedforward=0.0 * U,
            c=0.0 * U,
        )

    def _followed_regulation(self) -> Regulation | None:
        """Return the shared control law of the team, along its reference with the targets so far.

        None with open-loop prediction or a controller of the user.
        """
        setup = self._setup
        are_of_project = set(setup.scenario.controllers) == {"mpc"}
        if setup.settings.prediction != "closed_loop" or not are_of_project:
            return None

        reference = setup.reference.sampled
        if self._regulation is None:
            self._regulation = Regulation(setup.model, setup.hover, setup.settings, reference)
        elif reference is not self._followed:
            self._regulation.follow(reference)
        self._followed = reference
        return self._regulation
