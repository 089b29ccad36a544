"""The scene of a run at an instant: what is where, what everybody expects, which links are late or dark.

Arrays in, arrays out: what draws it is elsewhere, and so is whatever watches the clock.
"""

from dataclasses import dataclass

import numpy as np

from model.arrays import Array
from model.rotations import rotation
from model.state import INPUTS, StateView
from mpc.cost import Cost
from plant.schedule import FAIL_SAFE
from protocol.scenario.setup import Setup
from protocol.wire.messages import StepReport
from transport.log.run_log import LogError, RunLog
from transport.scene.link_history import LinkHistory, LinkState
from transport.scene.prediction import Predictor
from transport.scene.record import Record


@dataclass(frozen=True, slots=True, kw_only=True)
class Expectation:
    """What one agent expects over its horizon of N_p steps.

    Attributes:
        agent: 1-based.
        uavs_I: Its own UAVs, (N_p + 1, owned, 3), inertial frame, m.
        payload_I: The payload, (N_p + 1, 3), inertial frame, m.
    """

    agent: int
    uavs_I: Array
    payload_I: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentState:
    """One agent at an instant.

    Attributes:
        agent: 1-based.
        takes_part: Whether it is on the roster.
        report: How its step went, if it took one.
    """

    agent: int
    takes_part: bool
    report: StepReport | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """Everything there is to see at one tick; N UAVs, inertial frame with z down, SI.

    Attributes:
        tick: k.
        time_s: t_k.
        phase: Of the maneuver.
        payload_I: Position, (3,).
        payload_reference_I: Where it should be, (3,).
        R_payload: Attitude, payload to inertial frame, (3, 3).
        uavs_I: Positions, (N, 3).
        uav_references_I: Where they should be, (N, 3).
        R_uavs: Attitudes, body to inertial frame, (N, 3, 3).
        attachments_I: Where the rods are fixed to the payload, (N, 3).
        thrusts_I: Forces of the rotors, (N, 3), N.
        expectations: Of the agents that made a plan at this tick.
        links: Between agents.
        agents: All of them.
        cost: Stage cost.
        attitude_deg: Roll, pitch, yaw of the payload, (3,), deg.
        fail_safe: UAVs, 1-based, whose plans have run out.
    """

    tick: int
    time_s: float
    phase: str
    payload_I: Array
    payload_reference_I: Array
    R_payload: Array
    uavs_I: Array
    uav_references_I: Array
    R_uavs: Array
    attachments_I: Array
    thrusts_I: Array
    expectations: tuple[Expectation, ...]
    links: tuple[LinkState, ...]
    agents: tuple[AgentState, ...]
    cost: float
    attitude_deg: Array
    fail_safe: tuple[int, ...]

    @property
    def error_m(self) -> float:
        """Distance of the payload from its reference, m."""
        return float(np.linalg.norm(self.payload_I - self.payload_reference_I))


class Scenes:
    """Makes the scenes of one run.

    Args:
        setup: The run.
        record: What is known of it; may grow.
    """

    def __init__(self, setup: Setup, record: Record) -> None:
        self.setup, self.record = setup, record
        self.link_history = LinkHistory(setup)
        self._cost = Cost(setup.settings.weights, setup.hover)
        self._predictor: Predictor | None = None
        self._changed = 0
        self._places: dict[int, Array] = {}

    @classmethod
    def of(cls, setup: Setup, log: RunLog) -> "Scenes":
        """Those of a recorded run.

        Raises: LogError: no state of a flight can be read.
        """
        record = Record(setup)
        record.add(entry.message for entry in log.messages)
        if record.last < 0:
            raise LogError("the log: expected the states of a flight, got none that can be read")
        return cls(setup, record)

    def at(self, tick: int, *, expected: bool = True) -> Scene:
        """The scene at a tick, or at the nearest that was recorded; there is at least one.

        Args:
            tick: k.
            expected: Whether to work out what agents expect, which takes most of the time.
        """
        setup, tick = self.setup, self.record.nearest(tick)
        for change in self.record.changes[self._changed :]:
            self.link_history.change(change)
        self._changed = len(self.record.changes)
        plant_state = self.record.plant_states[tick]
        time_s = tick * setup.settings.sampling_period_s
        view, N = StateView(plant_state.x), setup.system.N
        R_payload, R_uavs = rotation(view.Theta0), np.array([rotation(Theta) for Theta in view.Theta])
        y, y_ref = setup.model.outputs(plant_state.x), setup.reference.outputs(np.array([time_s]))[0]
        thrusts = plant_state.u.reshape(N, INPUTS)[:, 0]
        reports = [self.record.report(agent, tick) for agent in setup.agents]
        members = self.record.members(tick)
        return Scene(
            tick=tick,
            time_s=time_s,
            phase=self.setup.maneuver.phase_at(time_s).name,
            payload_I=view.r0_I.copy(),
            payload_reference_I=setup.maneuver.path(np.array([time_s]))[0][0],
            R_payload=R_payload,
            uavs_I=y[: 3 * N].reshape(N, 3),
            uav_references_I=y_ref[: 3 * N].reshape(N, 3),
            R_uavs=R_uavs,
            attachments_I=np.array([view.r0_I + R_payload @ uav.rho for uav in setup.system.uavs]),
            thrusts_I=-thrusts[:, None] * R_uavs[:, :, 2],
            expectations=self._expectations(tick) if expected else (),
            links=self.link_history.states(tick, [report for report in reports if report is not None]),
            agents=tuple(
                AgentState(agent=agent, takes_part=agent in members, report=report)
                for agent, report in zip(setup.agents, reports, strict=True)
            ),
            cost=self._cost.stage(y, y_ref, plant_state.u),
            attitude_deg=np.degrees(view.Theta0),
            fail_safe=tuple(i + 1 for i, source in enumerate(plant_state.plan_ticks) if source == FAIL_SAFE),
        )

    def flown(self, tick: int, points: int) -> tuple[Array, Array]:
        """Where payload and UAVs have been until a tick, at some hundred instants at most.

        Args:
            tick: k.
            points: How many, about.
        Returns: Payload (k, 3) and UAVs (k, N, 3), inertial frame, m.
        """
        ticks = [k for k in self.record.plant_states if k <= tick]
        chosen = sorted(ticks)[:: max(1, len(ticks) // points)]
        chosen += [tick] if chosen[-1:] != [tick] else []
        places = np.array([self._place(k) for k in chosen])
        return places[:, 0], places[:, 1:]

    def _place(self, tick: int) -> Array:
        """Payload and UAVs at a tick, (1 + N, 3)."""
        if tick not in self._places:
            x = self.record.plant_states[tick].x
            y = self.setup.model.outputs(x)[: 3 * self.setup.system.N]
            self._places[tick] = np.vstack([StateView(x).r0_I, y.reshape(-1, 3)])
        return self._places[tick]

    def _expectations(self, tick: int) -> tuple[Expectation, ...]:
        if self._predictor is None:
            self._predictor = Predictor(self.setup)
        found = []
        for agent, owned in zip(self.setup.agents, self.setup.owned, strict=True):
            states = self._predictor.states(self.record, agent, tick)
            if states is not None and np.isfinite(states).all():
                y = np.array([self.setup.model.outputs(x) for x in states])[:, : 3 * self.setup.system.N]
                found.append(
                    Expectation(
                        agent=agent,
                        uavs_I=y.reshape(len(y), -1, 3)[:, list(owned)],
                        payload_I=StateView(states).r0_I,
                    )
                )
        return tuple(found)
