"""The scenario: one validated tree that describes a run. The docstring of a field is its meaning in docs/keys.md."""

import hashlib
import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args

import numpy as np
from annotated_types import Interval
from pydantic import AfterValidator, Field, ValidationInfo, model_validator

from transport.model.curves import Curve, ShapeKind
from transport.model.maneuver import PhaseKind, Profile
from transport.model.parameters import GRAVITY
from transport.mpc.settings import (
    ControllerSettings,
    Key,
    NotNegative,
    Positive,
    PositiveVector,
    Section,
    Vector,
)
from transport.protocol.scenario.files import TableError, way_of
from transport.protocol.scenario.link_sections import LinksSection
from transport.protocol.scenario.own_class import or_class
from transport.protocol.scenario.plant_sections import PlantSection
from transport.protocol.wire.messages import MAX_HORIZON, MAX_NEGOTIATION_ITERATIONS, MAX_POINTS
from transport.protocol.wire.names import MAX_UAVS


def _inertia(value: list[Any]) -> list[Any]:
    if [len(row) if isinstance(row, list) else 1 for row in value] not in ([1, 1, 1], [3, 3, 3]):
        raise ValueError(f"expected 3 principal moments or 3 rows of 3 numbers, got {value}")
    return value


Inertia = Annotated[
    list[float] | list[list[float]], AfterValidator(_inertia), Key(type="3 numbers or 3 rows of 3")
]
Relaxation = Annotated[
    Annotated[float, Interval(gt=0.0, le=1.0)] | Literal["auto"],
    Key(type="number > 0, <= 1, or auto", label="relaxation", short="relaxation"),
]
_WAIT_S = (1e-3, 1e6)


class PayloadSection(Section):
    """The carried body."""

    mass_kg: Annotated[Positive, Key(label="payload mass")]
    """payload mass m_0"""
    inertia_kgm2: Inertia
    """payload inertia J_0 about the centre of mass: principal moments along the body axes, or the symmetric matrix"""


class UavSection(Section):
    """One UAV and its rod."""

    id: Annotated[int, Interval(ge=1, le=MAX_UAVS)]
    """number of the UAV: 1, 2, ... in the order of the file"""
    mass_kg: Positive
    """mass m_i of the UAV"""
    inertia_kgm2: Inertia
    """inertia J_i of the UAV, given as that of the payload"""
    rho_m: Annotated[Vector, Key(within=(1e-12, 1e4))]
    """attachment point on the payload, payload frame: x forward, y right, z down"""
    rod_length_m: Annotated[Positive, Key(within=(1e-3, 1e4))]
    """rod length l_i"""


class SystemSection(Section):
    """The physical system."""

    gravity_mps2: Positive = GRAVITY
    """gravitational acceleration g"""
    payload: PayloadSection
    uav: Annotated[list[UavSection], Field(min_length=1, max_length=MAX_UAVS)]


class PhaseSection(Section):
    """One piece of the payload's path; a table or a curve defines displacement and, mostly, duration."""

    name: str
    """name of the phase in progress display and figures"""
    duration_s: Positive
    """duration of the phase"""
    displacement_m: Annotated[
        Vector, Key(within=(0.0, 1e5))
    ]  # that of a path from a file: a difference of its rows
    """displacement of the payload over the phase, inertial frame; up is negative z"""
    kind: PhaseKind = "move"
    """take_off and land are vertical, from and to the ground, where the payload stands for a quarter of the phase;
    circle, eight and spline are curves from rest to rest ([bring-your-own.md](bring-your-own.md#your-own-maneuver))"""
    way: Annotated[
        list[list[float]] | None, Key(type="rows of 4 numbers", unit="s and m", within=(0.0, 1e9))
    ] = None
    """the table of `file` after reading, or in its place: times since the start of the phase and positions relative to
    it, from zeros to duration and displacement, which can then be omitted; between rows at constant speed"""
    file: str | None = None
    """path of the phase as a table, instead of duration and displacement: CSV with the columns `t_s,x_m,y_m,z_m`,
    relative to the scenario's folder ([bring-your-own.md](bring-your-own.md#your-own-maneuver))"""
    size_m: Annotated[Vector, Key(within=(0.0, 1e5))] = (0.0, 0.0, 0.0)
    """a, b, c of a circle, (a sin A, b (1 - cos A), c sin A), or an eight, (a sin A, b sin 2 A, c sin A), with the
    angle A from 0 to 2 pi `laps`"""
    laps: Positive = 1.0
    """of a circle or eight"""
    points_m: Annotated[list[Vector] | None, Key(type="list of lists of 3 numbers", unit="m")] = (
        None
    )
    """way points of a spline after its start, relative to that"""
    times_s: Annotated[list[Positive] | None, Key(type="list of numbers > 0, rising", unit="s")] = (
        None
    )
    """times of the way points of a spline since its start; they define its duration"""
    speed_mps: Annotated[Positive | None, Key(label="largest speed")] = None
    """largest speed on a circle, eight or spline without times; it decides over `duration_s`"""
    ramp_s: Positive = 3.0
    """time in which a circle, eight or spline speeds up at its start, and slows down at its end"""
    formation: Annotated[list[Vector] | None, Key(type="rows of 3 numbers", unit="shares")] = None
    """rods lean out or in, with `reference` flat: rows of a share of the phase's duration, and length and width of a
    team from then on over those at hover ([equations.md](equations.md#references-that-a-team-can-fly), (66a))"""

    @model_validator(mode="before")
    @classmethod
    def _timed(cls, value: Any, info: ValidationInfo) -> Any:
        """Read the file; fill in duration and displacement of a table and a curve where their fields are valid."""
        if isinstance(value, dict) and isinstance(value.get("file"), str):
            for key in ("duration_s", "displacement_m", "way"):
                if key in value:
                    raise TableError(f"expected no {key} next to `file`, which defines it")
            way = way_of(Path(info.context or "") / value["file"])
            value = {key: given for key, given in value.items() if key != "file"} | {"way": way}
        try:
            if value.get("way"):
                duration_s, *displacement_m = value["way"][-1]
                return {"duration_s": duration_s, "displacement_m": displacement_m, **value}
            given = cls.model_construct(**value)
            if (curve := given.curve(2.0 * given.ramp_s)) is not None:
                if given.times_s is not None:
                    value = {**value, "duration_s": float(given.times_s[-1])}
                elif given.speed_mps is not None:
                    value = {
                        **value,
                        "duration_s": float(curve.fastest() / given.speed_mps + given.ramp_s),
                    }
                duration_s = value.get("duration_s", 2.0 * given.ramp_s)
                end_m = (
                    replace(curve, duration_s=duration_s)
                    .path(np.array([duration_s]), 1)[0, 0]
                    .tolist()
                )
                value = {"displacement_m": end_m, **value}
        except (TypeError, ValueError, AttributeError, IndexError):
            pass  # a wrong field is refused by its own check
        return value

    def curve(self, duration_s: float | None = None) -> Curve | None:
        """Return the curve of a circle, eight or spline, over its own duration by default; None for other kinds."""
        if self.kind not in get_args(ShapeKind):
            return None
        return Curve(
            kind=self.kind,  # type: ignore[arg-type]  # one of those
            duration_s=self.duration_s if duration_s is None else duration_s,
            ramp_s=self.ramp_s,
            size_I=tuple(self.size_m),
            laps=self.laps,
            points_I=self.points_m or (),
            times_s=self.times_s,
        )


class TargetSection(Section):
    """A target of the payload, given during the flight."""

    points_m: Annotated[
        list[Vector],
        Field(min_length=1, max_length=MAX_POINTS),
        Key(type=f"1 to {MAX_POINTS} lists of 3 numbers"),
    ]
    """the target, inertial frame (z down), or way points of a spline that is run through from the first one on"""
    speed_mps: Annotated[Positive | None, Key(label="largest speed")] = None
    """largest speed on the way; if omitted, that which the team can fly, at most 1 m/s"""
    times_s: Annotated[list[NotNegative] | None, Key(type="list of rising numbers", unit="s")] = (
        None
    )
    """times of the points instead of a speed; they count from that of the first one"""

    @model_validator(mode="after")
    def _points_differ_and_times_rise(self) -> Self:
        times_s, count = self.times_s, len(self.points_m)
        if times_s is not None and (
            len(times_s) != count
            or any(b <= a for a, b in pairwise(times_s))
            or self.speed_mps is not None
        ):
            raise ValueError(
                f"times_s: expected {count} rising times and no speed_mps, got {times_s}"
            )
        if any(a == b for a, b in pairwise(self.points_m)):
            raise ValueError(
                "points_m: expected each way point away from the one before, got the same twice"
            )
        return self


class ScriptedTargetSection(TargetSection):
    """A target that the coordinator announces at an instant, as it does for `transport target`."""

    at_s: NotNegative
    """time from which on the controllers know it"""


class ManeuverSection(Section):
    """Path of the payload."""

    start_m: Vector = (0.0, 0.0, -10.0)
    """payload position at t = 0, inertial frame; the run starts there at rest in hover"""
    reference: Literal["hover", "flat"] = "hover"
    """hover moved along the path, or the motion of the whole team that carries the payload along a smooth one
    ([equations.md](equations.md#references-that-a-team-can-fly)); needs closed_loop, along, riccati, preview"""
    profile: Profile = "ramp"
    """speed along a straight segment: constant, minimum jerk, a step, or smooth to the seventh derivative. smooth also
    replaces tables by splines from rest to rest, which round corners within some 0.5 s"""
    press_m: NotNegative = 0.2
    """distance of the controllers' reference below the payload that stands on the ground
    ([equations.md](equations.md#on-the-ground)): the larger, the less of its weight the team holds"""
    phase: Annotated[list[PhaseSection], Field(min_length=1), Key(short="phases")]
    target: list[ScriptedTargetSection] = []


class ObstacleSection(Section):
    """A body to keep clear of: in the reference and, with a flat one, in the program of every agent."""

    kind: Literal["sphere", "cylinder", "box", "gap"]
    """a cylinder is upright and without ends; a gap is the opening between two walls without other ends"""
    at_m: Annotated[Vector, Key(within=(0.0, 1e6))]
    """its centre, that of the opening of a gap; inertial frame, z down"""
    margin_m: Positive
    """smallest distance of the centre of a UAV, which holds half its size"""
    load_margin_m: NotNegative = 0.0
    """smallest distance of rods and of the payload, a box as far as its attachments"""
    radius_m: Positive | None = None
    """of a sphere or cylinder"""
    size_m: PositiveVector | None = None
    """edges of a box, along its heading, across, vertical"""
    width_m: Positive | None = None
    """of the opening of a gap"""
    thickness_m: Positive = 0.2
    """of the walls of a gap"""
    heading_deg: float = 0.0
    """direction of the first edge of a box, or of the passage through a gap, from x towards y"""
    penalty: Annotated[Positive, Key(unit="1/m", within=(1e-12, 1e8))] = 100.0
    """penalty on the largest violation of a margin over the horizon; only with a flat reference"""


class DisturbanceSection(Section):
    """Estimate of a constant force on the payload, compensated by the controller."""

    estimate: Annotated[bool, Key(short="estimate_disturbance")] = False
    """true: each agent estimates constant forces on payload and UAVs (a wrong mass, wind) and compensates them"""
    time_constant_s: Annotated[Positive, Key(label="time constant of the estimator")] = 1.0
    """time constant of the low-pass filter of the estimate"""


class ControllerSection(ControllerSettings):
    """The controller of every agent, and what it exchanges with the others."""

    horizon: Annotated[
        int, Interval(ge=1, le=MAX_HORIZON), Key(label="horizon", shown="steps", short="horizon")
    ] = 20
    """prediction horizon N_p, in sampling periods"""
    relaxation: Relaxation = 1.0  # type: ignore[assignment]  # a number in `Setup.settings`
    """share w of the new optimum in the published plan, the rest is the previous plan; with closed_loop of the
    corrections alone. auto: 1 over the number of agents"""
    received_plans: Literal["by_age", "by_one", "held"] = "by_age"
    """the others' plans in the horizon: shifted by their actual age; by one period at any age, as published; held"""
    received_states: Literal["predicted", "as_received"] = "predicted"
    """states of the others: predicted from the time of sending to now, or as received"""
    estimator: Literal["measured", "kalman"] = "measured"
    """measured states and a prediction of the others', or a Kalman filter over the whole team, which `plant.sensors`
    vehicle needs ([equations.md](equations.md#estimation-without-a-payload-sensor))"""
    negotiation_iterations: Annotated[
        int, Interval(ge=1, le=MAX_NEGOTIATION_ITERATIONS), Key(label="negotiation iterations")
    ] = 1
    """solves of each agent within a tick, with an exchange of plans after each ([time.md](time.md#negotiation))"""
    share: Annotated[Literal["always", "on_change"], Key(short="share")] = "always"
    """plans that an agent sends to the other agents: all, or only those that change what the others assume
    ([equations.md](equations.md) (49)). The plant receives every plan"""
    share_threshold: Annotated[
        NotNegative,
        Key(
            unit="share of the input's range",
            label="threshold of sharing",
            shown="% of the input's range",
        ),
    ] = 0.01
    """with on_change: change of the corrections above which a plan is sent, the largest over horizon and inputs"""
    share_heartbeat_s: Annotated[Positive, Key(label="longest time without a plan")] = 1.0
    """with on_change: longest interval between two plans sent, so that a lost plan is replaced"""
    silence: Literal["alone", "law"] = "alone"
    """with closed_loop, an agent whose news of the others are overdue: each of its UAVs gradually
    follows the reference alone, by its own sensors ([equations.md](equations.md#silence)), or the
    shared control law by the agent's estimate"""
    disturbance: DisturbanceSection = DisturbanceSection()


class AgentsSection(Section):
    """UAVs and controller of each agent. One agent for each UAV by default."""

    owned: Annotated[
        Annotated[list[Annotated[list[int], Field(min_length=1)]], Field(min_length=1)] | None,
        Key(type="list of lists of UAV ids", label="UAVs of each agent", short="owned"),
    ] = None
    """UAVs of each agent: agent 1 owns the first list, and so on; each UAV once. If omitted: one agent for each UAV"""
    controller: Annotated[
        str,
        or_class("mpc", "alone"),
        Key(type="mpc, alone, package.module:Class", label="controller", short="controller"),
    ] = "mpc"
    """controller of every agent: that of this project; alone, by which each UAV keeps to its part of the
    reference by its own sensors, without messages ([equations.md](equations.md#a-uav-alone)); or [your own
    class](bring-your-own.md#your-own-controller)"""
    failed_share: Annotated[
        float, Interval(ge=0.0, le=1.0), Key(label="allowed share of failed steps")
    ] = 0.05
    """largest share of an agent's steps that may fail; beyond it a run has failed, with exit code 7"""


class ClockSection(Section):
    """Sampling clock and membership."""

    mode: Literal["lockstep", "realtime"] = "lockstep"
    """a tick opens when all agents have answered the one before, or at its deadline"""
    speed: Annotated[NotNegative, Key(within=(1e-4, 1e4))] = 0.0
    """scenario seconds per second. 0: as fast as possible, in lockstep only; real time needs a number > 0"""
    actuation: Literal["immediate", "next_tick"] | None = None
    """a plan acts from its own tick on, or from the next; real time needs next_tick, lockstep prefers immediate"""
    barrier_timeout_s: Annotated[Positive, Key(within=_WAIT_S)] = 5.0
    """wall time after which a silent agent counts as lost, in real time also the plant"""
    join_timeout_s: Annotated[Positive, Key(within=_WAIT_S)] = 30.0
    """wall time the processes wait for each other at the start, in lockstep also a tick for a restarted agent"""
    on_agent_loss: Annotated[Literal["abort", "continue"], Key(short="on_agent_loss")] = "abort"
    """end the run with exit code 4, or continue without the agent, which may return"""
    on_overrun: Literal["continue", "hold", "abort"] = "continue"
    """in real time, when plans are missing at a deadline: open the next tick, hold it for them, or end the run"""
    overrun_limit: Annotated[int, Interval(ge=0)] = 0
    """with abort: number of plans that may miss their deadline"""
    overrun_limit_s: Annotated[Positive | None, Key(within=(1e-9, 1e6))] = None
    """with abort: largest delay of a plan after its deadline, and of the opening of a tick; wall time"""

    @property
    def next_tick(self) -> bool:
        """Return whether inputs act one tick after their state, as on hardware; always so in real time."""
        return self.mode == "realtime" if self.actuation is None else self.actuation == "next_tick"


class FaultSection(Section):
    """Fault of a process or a UAV at an instant of the run."""

    at_s: NotNegative
    """scenario time of the fault"""
    do: Literal["kill", "stop", "continue", "restart", "motor_off", "release", "degrade"]
    """kill: SIGKILL; stop: SIGSTOP; continue: SIGCONT; restart: start an agent again; motor_off: thrust and moments of
    a UAV are zero; release: it also leaves its rod; degrade: its motors produce only a share from then on"""
    target: Annotated[str, Key(type="coordinator, plant, agent1, agent2, ...; or uav1, uav2, ...")]
    """affected process, or UAV for motor_off, release and degrade"""
    efficiency: Annotated[float, Interval(gt=0.0, le=1.0)] | None = None
    """with degrade, and required there: share of the commands that the motors produce"""


class FaultsSection(Section):
    """Scripted faults."""

    event: Annotated[list[FaultSection], Key(short="faults")] = []


class NetworkSection(Section):
    """Addresses of the processes: coordinator at the base port, plant, agents above that; not in the digest."""

    host: Annotated[
        str, Field(pattern=r"^[A-Za-z0-9_:%-]{1,63}(\.[A-Za-z0-9_:%-]{1,63}){0,9}$")
    ] = "127.0.0.1"
    """address the processes listen on; beyond the loopback interface only with `keys` or `insecure`"""
    base_port: Annotated[int, Interval(ge=1024, le=65_000)] | None = None
    """port of the coordinator, then plant, agent 1, ... Default: free ports, or 7447 with processes started by hand"""
    router: Annotated[str, Field(pattern=r"^(tcp|tls)/\S+:\d+$")] | None = None
    """address of a router, `tls/192.0.2.1:7447`: all processes are its clients ([deploy.md](deploy.md#topologies))"""
    keys: Annotated[str, Field(pattern=r"^[^\x00]*$")] | None = None
    """folder of certificates, relative to the current folder: TLS and access control on every link
    ([deploy.md](deploy.md#access-control))"""
    insecure: bool = False
    """true: listen unencrypted on an address that other hosts can reach"""
    secret: bool = True
    """false: any local process can connect to a run without `keys` and `router`, also without its random secret
    ([deploy.md](deploy.md#a-run-on-one-host))"""


class Scenario(Section):
    """The whole description of a run."""

    schema_version: Annotated[Literal[1], Field(alias="schema")] = 1
    """version of this format"""
    name: Annotated[
        str,
        Field(pattern=r"^[A-Za-z0-9_-]{1,40}$"),
        Key(type="text: letters, digits, `_`, `-`; at most 40"),
    ]
    """name of the run, part of every network key and of the run folder"""
    seed: Annotated[int, Interval(ge=0, lt=2**63), Key(type="integer >= 0", short="seed")] = 0
    """seed of all random numbers of a run: `[links]`, wind and noise"""
    system: SystemSection
    maneuver: ManeuverSection
    obstacle: Annotated[list[ObstacleSection], Key(short="obstacles")] = []
    controller: ControllerSection = ControllerSection()
    agents: AgentsSection = AgentsSection()
    clock: ClockSection = ClockSection()
    links: LinksSection = LinksSection()
    faults: FaultsSection = FaultsSection()
    plant: PlantSection = PlantSection()
    network: NetworkSection = NetworkSection()

    @property
    def owned(self) -> tuple[tuple[int, ...], ...]:
        """Return the UAV ids of agent 1, agent 2, ..."""
        if self.agents.owned is None:
            return tuple((uav.id,) for uav in self.system.uav)
        return tuple(tuple(sorted(group)) for group in self.agents.owned)

    def tree(self) -> dict[str, Any]:
        """Return the scenario as plain data with every default, for writing back and for the digest."""
        return self.model_dump(mode="json", by_alias=True, exclude_none=True)

    def digest(self) -> str:
        """Return the fingerprint of everything but the network addresses, equal in all processes of a run."""
        tree = {key: value for key, value in self.tree().items() if key != "network"}
        return hashlib.sha256(json.dumps(tree, sort_keys=True).encode()).hexdigest()[:12]
