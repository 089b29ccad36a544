"""A run by tick, as far as its log has been read.

Messages, poses, predicted paths, links; no drawing, no clock.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import permutations
from typing import NamedTuple

import numpy as np

from transport.agent.announced import AnnouncedInputs
from transport.log.run_log import LogError, RunLog
from transport.model.arrays import Array
from transport.model.rotations import rotation
from transport.model.state import INPUTS, StateView
from transport.mpc.feedback import FeedbackLaw
from transport.mpc.reference import Sampled
from transport.mpc.regulation import Regulation
from transport.mpc.rollout import rollout
from transport.plant.actuators import FAIL_SAFE
from transport.protocol.scenario.link_changes import words_of
from transport.protocol.scenario.setup import Setup
from transport.protocol.scenario.stage_cost import StageCost
from transport.protocol.scenario.targets import target_in_words
from transport.protocol.wire.messages import (
    NO_NEWS,
    Airtime,
    Control,
    FaultNote,
    LinkChange,
    Message,
    Plan,
    PlantState,
    Roster,
    StepReport,
    Target,
)

# Kinds of messages that a history keeps.
KINDS = frozenset(
    kind.kind
    for kind in (
        *(PlantState, Plan, StepReport, Airtime),
        *(LinkChange, Target, Roster, FaultNote, Control),
    )
)
_AIR_S = 1.0  # time before a tick over which the radio is shown


class RunHistory:
    """Messages of one run; grows while a live run is read."""

    def __init__(self, setup: Setup) -> None:
        self.setup = setup  # with the targets so far
        self.plant_states: dict[
            int, PlantState
        ] = {}  # by tick, which can be shown once its plant state is here
        self.first, self.last = 0, -1  # ticks from and until which can be shown
        self.plans: dict[tuple[int, int], Plan] = {}  # by agent and tick, as the reports of steps
        self.reports: dict[tuple[int, int], StepReport] = {}
        self.airtimes: dict[int, list[Airtime]] = {}  # news of the radio, by tick
        self.link_changes: list[LinkChange] = []
        self.control: Control | None = None  # the coordinator's message about the end
        self.events: list[
            tuple[int, str]
        ] = []  # ticks and sentences about faults, links and roster
        self._rosters: list[Roster] = []

    def add(self, messages: Iterable[Message]) -> None:
        """Add messages; skip those that do not fit the run."""
        for message in messages:
            match message:
                case PlantState() if message.x.shape == self.setup.hover.x.shape:
                    self.first = (
                        min(self.first, message.tick) if self.plant_states else message.tick
                    )
                    self.last = max(self.last, message.tick)
                    self.plant_states[message.tick] = message
                case Plan(negotiation=0):
                    self.plans[message.agent, message.tick] = message
                case StepReport():
                    self.reports[message.agent, message.tick] = message
                case Airtime():
                    self.airtimes.setdefault(message.tick, []).append(message)
                case LinkChange() if message.number == len(self.link_changes) + 1:
                    self.link_changes.append(message)
                    self.events.append((message.tick, words_of(message)))
                case Target() if message.number == len(self.setup.maneuver.targets) + 1:
                    self.setup = self.setup.after([message])
                    self.events.append((message.tick, target_in_words(message)))
                case Roster():
                    self._rosters.append(message)
                    if message.version > 1 and not message.reason.startswith(
                        ("links ", "target (")
                    ):
                        self.events.append((message.tick, message.reason))
                case FaultNote():
                    self.events.append((message.tick, f"{message.target} {message.what}"))
                case Control():
                    self.control = message

    def nearest(self, tick: int) -> int:
        """Return the newest recorded tick up to `tick`, or the first one.

        At least one must be recorded.
        """
        if tick in self.plant_states:
            return tick
        return max(
            (recorded for recorded in self.plant_states if recorded < tick), default=self.first
        )

    def roster(self, tick: int) -> Roster | None:
        """Return the roster at a tick; None while none is known."""
        known = [roster for roster in self._rosters if roster.tick <= tick]
        return max(known, key=lambda roster: roster.version, default=None)


class Air(NamedTuple):
    """The radio of the team over the last second."""

    airtime_share: float
    delivered_share: float | None  # None without plans


class PredictedPaths(NamedTuple):
    """Paths that one agent predicts over its horizon of N_p steps, inertial frame, m."""

    agent: int  # 1-based
    uavs_I: Array  # its own UAVs, (N_p + 1, owned, 3)
    payload_I: Array  # (N_p + 1, 3)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """Everything to show at one tick.

    N UAVs, inertial frame with z down, SI; agents and UAVs are 1-based.
    """

    tick: int
    time_s: float
    phase: str
    payload_I: Array  # position, (3,)
    payload_reference_I: Array  # (3,)
    R_payload: Array  # payload to inertial frame, (3, 3)
    uavs_I: Array  # positions, (N, 3)
    R_uavs: Array  # body to inertial frames, (N, 3, 3)
    attachments_I: Array  # of the rods to the payload, (N, 3)
    thrusts_I: Array  # forces, (N, 3), N
    predictions: tuple[PredictedPaths, ...]  # of the agents that made a plan at this tick
    # Sender, receiver and age, s, of the sender's newest plan that the receiver used; None if it
    # used none.
    links: tuple[tuple[int, int, float | None], ...]
    members: frozenset[int]  # agents on the roster
    reports: tuple[StepReport | None, ...]  # of all agents
    error_m: float  # distance of the payload from its reference
    cost: float  # stage cost
    attitude_deg: Array  # roll, pitch, yaw of the payload, (3,)
    fail_safe: tuple[int, ...]  # UAVs whose plans have run out
    released: tuple[int, ...]  # UAVs that have left their rods
    air: Air | None = None  # without a radio: None


class SceneBuilder:
    """Builder of the scenes of one run, whose history may grow."""

    def __init__(self, setup: Setup, history: RunHistory) -> None:
        self.history = history
        # Positions of the UAVs at the start of the reference, (N, 3), m, and mean thrust of a UAV
        # at hover, N.
        self.start_I = setup.reference.outputs(np.zeros(1))[0, : 3 * setup.system.N].reshape(-1, 3)
        self.hover_N = float(np.mean(setup.hover.u[::INPUTS]))
        self._cost = StageCost(setup)
        self._regulation: Regulation | None = None
        self._followed: Sampled | None = None  # the reference that it follows
        self._positions: dict[int, Array] = {}

    @property
    def setup(self) -> Setup:
        """The run, with its targets so far."""
        return self.history.setup

    @classmethod
    def of(cls, setup: Setup, log: RunLog) -> "SceneBuilder":
        """Return the builder for a recorded run.

        Raises: LogError: the log holds no readable plant state.
        """
        history = RunHistory(setup)
        history.add(entry.message for entry in log.messages)
        if history.last < 0:
            raise LogError("the log: expected the states of a run, got none that can be read")
        return cls(setup, history)

    def at(self, tick: int) -> Scene:
        """Return the scene at a tick, or at the nearest recorded one.

        At least one must be recorded.
        """
        setup, history, tick = self.setup, self.history, self.history.nearest(tick)
        plant_state, roster = history.plant_states[tick], history.roster(tick)
        time_s = tick * setup.settings.sampling_period_s
        view, positions_I = StateView(plant_state.x), self._position(tick)
        R_payload, R_uavs = (
            rotation(view.Theta0),
            np.array([rotation(Theta) for Theta in view.Theta]),
        )
        error_m, cost = self.error_and_cost(tick)
        return Scene(
            tick=tick,
            time_s=time_s,
            phase=setup.maneuver.phase_at(time_s).name,
            payload_I=positions_I[0],
            payload_reference_I=setup.maneuver.path(np.array([time_s]))[0][0],
            R_payload=R_payload,
            uavs_I=positions_I[1:],
            R_uavs=R_uavs,
            attachments_I=np.array([view.r0_I + R_payload @ uav.rho for uav in setup.system.uavs]),
            thrusts_I=-plant_state.u[::INPUTS, None] * R_uavs[:, :, 2],
            predictions=self._predictions(tick),
            links=self._links(tick),
            members=frozenset(setup.agents if roster is None else roster.agents),
            reports=tuple(history.reports.get((agent, tick)) for agent in setup.agents),
            error_m=error_m,
            cost=cost,
            attitude_deg=np.degrees(view.Theta0),
            fail_safe=tuple(
                i + 1 for i, source in enumerate(plant_state.plan_ticks) if source == FAIL_SAFE
            ),
            released=() if roster is None else tuple(roster.released),
            air=self._air(tick),
        )

    def _air(self, tick: int) -> Air | None:
        """Return what the radio carried in the last second; None without one."""
        if self.setup.scenario.radio is None:
            return None
        period_s = self.setup.settings.sampling_period_s
        ticks = max(1, min(round(_AIR_S / period_s), tick))
        news = [
            one
            for k in range(tick - ticks + 1, tick + 1)
            for one in self.history.airtimes.get(k, ())
        ]
        arrivals = [one.arrivals[one.arrivals != NO_NEWS] for one in news]
        decided = np.concatenate(arrivals) if arrivals else np.zeros(0)
        return Air(
            airtime_share=sum(one.busy_s for one in news) / (ticks * period_s),
            delivered_share=float(np.mean(decided >= 0.0)) if len(decided) else None,
        )

    def _links(self, tick: int) -> tuple[tuple[int, int, float | None], ...]:
        ages = {
            (peer, receiver): age * self.setup.settings.sampling_period_s
            for receiver in self.setup.agents
            if (report := self.history.reports.get((receiver, tick))) is not None
            for peer, age in zip(report.peers, report.plan_ages, strict=True)
            if age >= 0
        }
        return tuple((*ends, ages.get(ends)) for ends in permutations(self.setup.agents, 2))

    def error_and_cost(self, tick: int) -> tuple[float, float]:
        """Return the payload's distance from its reference, m, and the stage cost, at a recorded tick."""
        setup, plant_state = self.setup, self.history.plant_states[tick]
        time_s = np.array([tick * setup.settings.sampling_period_s])
        y, y_ref = setup.model.outputs(plant_state.x), setup.reference.outputs(time_s)[0]
        error_I = StateView(plant_state.x).r0_I - setup.maneuver.path(time_s)[0][0]
        return float(np.linalg.norm(error_I)), self._cost.at(tick, y, y_ref, plant_state.u)

    def paths(self, tick: int, points: int) -> tuple[Array, Array]:
        """Return the flown paths of payload, (k, 3), and UAVs, (k, N, 3), m, until a tick, by some points."""
        # A copy: a page may ask while the log is read.
        ticks = sorted(k for k in list(self.history.plant_states) if k < tick)
        positions = np.array(
            [self._position(k) for k in [*ticks[:: max(1, len(ticks) // points)], tick]]
        )
        return positions[:, 0], positions[:, 1:]

    def _position(self, tick: int) -> Array:
        """Return the positions of payload and UAVs at a tick, (1 + N, 3)."""
        if tick not in self._positions:
            x = self.history.plant_states[tick].x
            y = self.setup.model.outputs(x)[: 3 * self.setup.system.N]
            self._positions[tick] = np.vstack([StateView(x).r0_I, y.reshape(-1, 3)])
        return self._positions[tick]

    def _predictions(self, tick: int) -> tuple[PredictedPaths, ...]:
        predictions = []
        for agent, owned in zip(self.setup.agents, self.setup.owned, strict=True):
            states = self._predicted_states(agent, tick)
            if states is not None and np.isfinite(states).all():
                y = np.array([self.setup.model.outputs(x) for x in states])[
                    :, : 3 * self.setup.system.N
                ]
                uavs_I = y.reshape(len(y), -1, 3)[:, list(owned)]
                predictions.append(PredictedPaths(agent, uavs_I, StateView(states).r0_I))
        return tuple(predictions)

    def _predicted_states(self, agent: int, tick: int) -> Array | None:
        """Return the states that an agent predicted with its plan of a tick, (N_p + 1, n).

        Equations.md (32), (35).

        None without a plan of that tick, and while an agent or UAV is off the roster.
        """
        history, setup = self.history, self.setup
        own, plant_state, roster = (
            history.plans.get((agent, tick)),
            history.plant_states[tick],
            history.roster(tick),
        )
        if own is None or (
            roster is not None and (set(roster.agents) != set(setup.agents) or roster.off)
        ):
            return None
        report, steps = history.reports.get((agent, tick)), setup.settings.horizon
        alignment = setup.scenario.controller.received_plans
        announced = AnnouncedInputs(setup.owned, setup.hover.u, alignment=alignment, own=agent)
        announced.add(own)
        x, z0, forces = plant_state.x, plant_state.x, np.zeros(3 + 3 * setup.system.N)
        if setup.settings.motor_lag_s > 0.0:
            z0 = np.concatenate([x, plant_state.u])  # as if the motors had followed
        if report is not None:
            forces[:3] = report.force
            for peer, age in zip(report.peers, report.plan_ages, strict=True):
                if age >= 0 and (used := history.plans.get((peer, tick - age))) is not None:
                    announced.add(used)
        law, regulation = None, self._law()
        if regulation is not None:
            c = announced.corrections(tick, steps, tick + 1)
            law = regulation.law(z0, setup.X_ref[tick : tick + steps], c, forces, tick)
        if law is None:
            # Inputs before the start of the plan are already fixed.
            first = min(max(own.start_tick - tick, 0), steps)
            U = np.tile(plant_state.u, (steps, 1))
            U[first:] = announced.sequence(own.start_tick, steps - first, tick + 1)
            none = np.zeros((steps, len(z0)))
            law = FeedbackLaw(
                K=np.zeros((U.shape[1], len(z0))),
                u_rest=U,
                error=none,
                feedforward=0.0 * U,
                c=0.0 * U,
            )
        return rollout(setup.model, setup.settings, z0, law, forces)[0][:, : len(x)]

    def _law(self) -> Regulation | None:
        """Return the shared control law of the team.

        None with open-loop prediction or a controller of the user.
        """
        setup = self.setup
        if setup.settings.prediction != "closed_loop" or setup.scenario.agents.controller != "mpc":
            return None
        reference = setup.reference.sampled
        if self._regulation is None:
            self._regulation = Regulation(setup.model, setup.hover, setup.settings, reference)
        elif reference is not self._followed:
            self._regulation.follow(reference)
        self._followed = reference
        return self._regulation
