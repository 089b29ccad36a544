"""A run by tick, as far as its log has been read: messages, poses, predicted paths and links.

Nothing here draws or reads a clock.
"""

from dataclasses import dataclass
from itertools import permutations
from typing import NamedTuple

import numpy as np

from transport.log.run_log import LogError, RunLog
from transport.model.arrays import Array
from transport.model.physics.rotations import rotation
from transport.model.state import INPUTS, StateView
from transport.plant.actuator_schedule import FAIL_SAFE
from transport.protocol.scenario.setup.cost_of_run import StageCost
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import PlantState, StepReport
from transport.scene.history import RunHistory
from transport.scene.predictions import PredictedPaths, Predictions

# Sender, receiver and age, s, of the sender's newest plan that the receiver used; None if it used
# none.
Link = tuple[int, int, float | None]

# Time before a tick over which the radio is shown, s.
_AIR_S = 1.0


class Air(NamedTuple):
    """The radio of the team over the last second."""

    airtime_share: float  # of that second
    delivered_share: float | None  # of the copies of plans; None without any


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """State of a run at one tick, as it is shown.

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
    links: tuple[Link, ...]
    members: frozenset[int]  # agents on the roster
    reports: tuple[StepReport | None, ...]  # of all agents
    error_m: float  # distance of the payload from its reference
    cost: float  # stage cost
    attitude_deg: Array  # roll, pitch, yaw of the payload, (3,)
    fail_safe: tuple[int, ...]  # UAVs on their fail-safe, without a newer plan
    released: tuple[int, ...]  # UAVs that have left their rods
    air: Air | None = None  # without a radio: None


class SceneBuilder:
    """Builder of the scenes of one run, whose history may grow."""

    def __init__(self, setup: Setup, history: RunHistory) -> None:
        self.history = history
        self._positions_count = 3 * setup.system.N
        # Positions of the UAVs at the start of the reference, (N, 3), m.
        y_start = setup.reference.outputs(np.zeros(1))[0]
        self.start_I = y_start[: self._positions_count].reshape(-1, 3)
        # Mean thrust of a UAV at hover, N.
        self.hover_N = float(np.mean(setup.hover.u[::INPUTS]))
        self._cost = StageCost(setup)
        self._predictions = Predictions(history)
        self._positions: dict[int, Array] = {}  # by tick

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
        setup = self.setup
        tick = self.history.nearest(tick)
        time_s = tick * setup.settings.sampling_period_s
        plant_state = self.history.plant_states[tick]
        roster = self.history.roster(tick)

        view = StateView(plant_state.x)
        positions_I = self._position(tick)
        R_payload = rotation(view.Theta0)
        R_uavs = np.array([rotation(Theta) for Theta in view.Theta])
        attachments_I = [view.r0_I + R_payload @ uav.rho for uav in setup.system.uavs]
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
            attachments_I=np.array(attachments_I),
            thrusts_I=_thrusts(plant_state, R_uavs),
            predictions=self._predictions.paths(tick),
            links=self._links(tick),
            members=frozenset(setup.agents if roster is None else roster.agents),
            reports=tuple(self.history.reports.get((agent, tick)) for agent in setup.agents),
            error_m=error_m,
            cost=cost,
            attitude_deg=np.degrees(view.Theta0),
            fail_safe=_without_plan(plant_state),
            released=() if roster is None else tuple(roster.released),
            air=self._air(tick),
        )

    def _air(self, tick: int) -> Air | None:
        """Return the load and the deliveries of the radio in the last second; None without one."""
        if self.setup.scenario.radio is None:
            return None

        period_s = self.setup.settings.sampling_period_s
        ticks = max(1, min(round(_AIR_S / period_s), tick))
        airtimes = []
        for shown in range(tick - ticks + 1, tick + 1):
            airtimes += self.history.airtimes.get(shown, [])

        # Times of arrival, s; lost copies have negative codes.
        arrivals = [one.of_sent() for one in airtimes]
        decided = np.concatenate(arrivals) if arrivals else np.zeros(0)
        return Air(
            airtime_share=sum(one.busy_s for one in airtimes) / (ticks * period_s),
            delivered_share=float(np.mean(decided >= 0.0)) if len(decided) else None,
        )

    def _links(self, tick: int) -> tuple[Link, ...]:
        """Return the links between all agents, with the ages of the plans that were used."""
        ages_s: dict[tuple[int, int], float] = {}
        for receiver in self.setup.agents:
            report = self.history.reports.get((receiver, tick))
            if report is None:
                continue
            for sender, age in zip(report.peers, report.plan_ages, strict=True):
                if age >= 0:
                    ages_s[sender, receiver] = age * self.setup.settings.sampling_period_s
        return tuple((*ends, ages_s.get(ends)) for ends in permutations(self.setup.agents, 2))

    def error_and_cost(self, tick: int) -> tuple[float, float]:
        """Return the payload's error, m, and the stage cost, at a recorded tick.

        The error is the distance from the reference.
        """
        setup = self.setup
        plant_state = self.history.plant_states[tick]
        time_s = np.array([tick * setup.settings.sampling_period_s])

        r0_ref_I = setup.maneuver.path(time_s)[0][0]
        error_I = StateView(plant_state.x).r0_I - r0_ref_I

        y = setup.model.outputs(plant_state.x)
        y_ref = setup.reference.outputs(time_s)[0]
        cost = self._cost.at(tick, y, y_ref, plant_state.u)
        return float(np.linalg.norm(error_I)), cost

    def paths(self, tick: int, points: int) -> tuple[Array, Array]:
        """Return the paths of payload, (k, 3), and UAVs, (k, N, 3), m, until a tick.

        The paths have about the given number of points.
        """
        recorded = list(self.history.plant_states)  # a page may ask while the log is read
        earlier = sorted(one for one in recorded if one < tick)
        stride = max(1, len(earlier) // points)
        positions_I = np.array([self._position(k) for k in [*earlier[::stride], tick]])
        return positions_I[:, 0], positions_I[:, 1:]

    def _position(self, tick: int) -> Array:
        """Return the positions of payload and UAVs at a tick, (1 + N, 3)."""
        if tick not in self._positions:
            x = self.history.plant_states[tick].x
            uavs_I = self.setup.model.outputs(x)[: self._positions_count].reshape(-1, 3)
            self._positions[tick] = np.vstack([StateView(x).r0_I, uavs_I])
        return self._positions[tick]


def _thrusts(plant_state: PlantState, R_uavs: Array) -> Array:
    """Return the thrust of each UAV as a force, (N, 3), inertial frame, N.

    F_i = -f_i R_i e_z: with z down a UAV lifts along its body axis -z.
    """
    thrusts_N = plant_state.u[::INPUTS]
    body_z_I = R_uavs[:, :, 2]
    return np.asarray(-thrusts_N[:, None] * body_z_I)


def _without_plan(plant_state: PlantState) -> tuple[int, ...]:
    """Return the UAVs on their fail-safe, without a newer plan."""
    sources = enumerate(plant_state.plan_ticks, start=1)
    return tuple(uav for uav, source in sources if source == FAIL_SAFE)
