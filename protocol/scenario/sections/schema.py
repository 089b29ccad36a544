"""The scenario, one validated tree that describes a run.

The docstring of a field is its meaning in docs/reference/keys.md.
"""

import hashlib
import json
from typing import Annotated, Any, Literal

from annotated_types import Interval
from pydantic import Field

from transport.model.physics.parameters import GRAVITY
from transport.model.section import Inertia, Key, NotNegative, Pair, Positive, Section, Vector
from transport.mpc.settings_period_horizon_weights import (
    DEFAULT_HORIZON,
    DEFAULT_RELAXATION,
    ControllerSettings,
)
from transport.protocol.scenario.sections.fault_sections import FaultsSection
from transport.protocol.scenario.sections.link_sections import LinksSection
from transport.protocol.scenario.sections.lockstep_and_realtime_section import ClockSection
from transport.protocol.scenario.sections.maneuver_sections import ManeuverSection, ObstacleSection
from transport.protocol.scenario.sections.plant_sections import PlantSection
from transport.protocol.scenario.sections.radio_section import RadioSection
from transport.protocol.scenario.sections.vehicles_section import VehiclesSection
from transport.protocol.scenario.user_class.user_import import or_class
from transport.protocol.wire.messages import MAX_HORIZON, MAX_NEGOTIATION_ITERATIONS
from transport.protocol.wire.names import MAX_UAVS

Relaxation = Annotated[
    Annotated[float, Interval(gt=0.0, le=1.0)] | Literal["auto"],
    Key(type="number > 0, <= 1, or auto", label="relaxation", short="relaxation"),
]
NO_DRAG = (0.0, 0.0)  # of a UAV
LONGEST_NAME = 40  # characters of the name of a scenario


class PayloadSection(Section):
    """The carried body."""

    mass_kg: Annotated[Positive, Key(label="payload mass")]
    """payload mass m_0"""
    inertia_kgm2: Inertia
    """payload inertia J_0 about the centre of mass: principal moments along the body axes, or the
    symmetric matrix"""
    drag_kgps: Annotated[NotNegative, Key(label="payload drag")] = 0.0
    """drag d_0: force against its velocity relative to the air per m/s,
    [equations.md](../equations.md) (42)"""


class UavSection(Section):
    """One UAV and its rod."""

    id: Annotated[int, Interval(ge=1, le=MAX_UAVS)]
    """number of the UAV: 1, 2, ... in the order of the file"""
    mass_kg: Positive
    """mass m_i of the UAV"""
    inertia_kgm2: Inertia
    """inertia J_i of the UAV, given as that of the payload"""
    drag_kgps: Annotated[Pair, Key(type="2 numbers >= 0", label="UAV drag")] = NO_DRAG
    """drag d_i in the plane of the rotors, and along their axis: force against its velocity relative
    to the air per m/s, [equations.md](../equations.md) (42)"""
    rho_m: Annotated[Vector, Key(within=(1e-12, 1e4))]
    """attachment point on the payload, payload frame: x forward, y right, z down"""
    rod_length_m: Annotated[Positive, Key(within=(1e-3, 1e4))]
    """rod length l_i"""
    radius_m: Annotated[Positive, Key(within=(1e-3, 1e2))] | None = None
    """radius of the sphere that the UAV fills: two that touch have collided
    ([guarantees.md](../record/guarantees.md#collisions)); without it no contact is told"""


class SystemSection(Section):
    """The physical system."""

    gravity_mps2: Positive = GRAVITY
    """gravitational acceleration g"""
    payload: PayloadSection
    uav: Annotated[list[UavSection], Field(min_length=1, max_length=MAX_UAVS)]


class DisturbanceSection(Section):
    """Estimate of constant forces on payload and UAVs, compensated by the controller."""

    estimate: Annotated[bool, Key(short="estimate_disturbance")] = False
    """true: each agent estimates constant forces on payload and UAVs (a wrong mass, wind) and
    compensates them"""
    time_constant_s: Annotated[Positive, Key(label="time constant of the estimator")] = 1.0
    """time constant of the low-pass filter of the estimate"""


class ControllerSection(ControllerSettings):
    """The controller of every agent, and what it exchanges with the others."""

    horizon: Annotated[
        int, Interval(ge=1, le=MAX_HORIZON), Key(label="horizon", shown="steps", short="horizon")
    ] = DEFAULT_HORIZON
    """prediction horizon N_p, in sampling periods"""
    relaxation: Relaxation = DEFAULT_RELAXATION  # type: ignore[assignment]  # a number in `Setup.settings`
    """share w of the new optimum in the published plan, the rest is the previous plan; with
    closed_loop of the corrections alone. auto: 1 over the number of agents"""
    knows_drag: bool = True
    """true: the controllers' model, reference and control laws have the drag of `[system]`; false:
    they assume bodies without drag"""
    received_plans: Literal["by_age", "by_one", "held"] = "by_age"
    """the others' plans in the horizon: shifted by their actual age; by one period at any age, as
    published; held"""
    received_states: Literal["predicted", "as_received"] = "predicted"
    """states of the others: predicted from the time of sending to now, or as received"""
    estimator: Literal["measured", "kalman"] = "measured"
    """measured states and a prediction of the others', or a Kalman filter over the whole team,
    which `plant.sensors` vehicle needs
    ([equations](../equations/estimation.md#estimation-without-a-payload-sensor))"""
    negotiation_iterations: Annotated[
        int, Interval(ge=1, le=MAX_NEGOTIATION_ITERATIONS), Key(label="negotiation iterations")
    ] = 1
    """solves of each agent within a tick, with an exchange of plans after each
    ([time.md](../time.md#negotiation))"""
    share: Annotated[Literal["always", "on_change"], Key(short="share")] = "always"
    """plans that an agent sends to the other agents: all, or only those that change what the others
    assume ([equations.md](../equations.md) (49)). The plant receives every plan"""
    share_threshold: Annotated[
        NotNegative,
        Key(
            unit="share of the input's range",
            label="threshold of sharing",
            shown="% of the input's range",
        ),
    ] = 0.01
    """with on_change: change of the corrections above which a plan is sent, the largest over
    horizon and inputs"""
    share_heartbeat_s: Annotated[Positive, Key(label="longest time without a plan")] = 1.0
    """with on_change: longest interval between two plans sent, so that a lost plan is replaced"""
    silence: Literal["alone", "law", "stop"] = "alone"
    """with closed_loop, what an agent does when its information about the others is overdue
    ([equations](../equations/information.md#silence)). alone: each of its UAVs gradually follows its part of
    the motion of the team alone, by its own sensors; law: they follow the shared control law; stop: as
    alone, and the agent's path comes to a rest, and goes on with the others once there is information"""
    targets: Literal["eager", "confirmed"] = "eager"
    """when an agent follows a target that it has heard of in a plan, or that only some are told: eager: at
    once; confirmed: once all agents on the roster are known to have it, and the path before goes on
    until then ([equations](../equations/information.md#targets-told-to-some))"""
    disturbance: DisturbanceSection = DisturbanceSection()


UavIds = Annotated[list[int], Field(min_length=1)]
Groups = Annotated[list[UavIds], Field(min_length=1)]


class AgentsSection(Section):
    """UAVs and controller of each agent. One agent for each UAV by default."""

    owned: Annotated[
        Groups | None,
        Key(type="list of lists of UAV ids", label="UAVs of each agent", short="owned"),
    ] = None
    """UAVs of each agent: agent 1 owns the first list, and so on; each UAV once. If omitted: one
    agent for each UAV"""
    controller: Annotated[
        str | list[str],
        or_class("mpc", "alone"),
        Key(
            type="mpc, alone, package.module:Class, or a list of one for each agent",
            label="controller",
            short="controller",
        ),
    ] = "mpc"
    """controller of every agent, or of each: that of this project; alone, by which each UAV keeps to its part of the
    reference by its own sensors, whatever messages say ([equations](../equations/alone.md#a-uav-alone)); or [your own
    class](../own-controller.md)"""
    failed_share: Annotated[
        float, Interval(ge=0.0, le=1.0), Key(label="allowed share of failed steps")
    ] = 0.05
    """largest share of an agent's steps that may fail; beyond it a run has failed, with exit code 7"""


class NetworkSection(Section):
    """Addresses of processes: coordinator at the base port, plant, agents. Not in the digest."""

    host: Annotated[
        str, Field(pattern=r"^[A-Za-z0-9_:%-]{1,63}(\.[A-Za-z0-9_:%-]{1,63}){0,9}$")
    ] = "127.0.0.1"
    """address the processes listen on; beyond the loopback interface only with `keys` or
    `insecure`"""
    base_port: Annotated[int, Interval(ge=1024, le=65_000)] | None = None
    """port of the coordinator, then plant, agent 1, ... Default: free ports, or 7447 with processes
    started by hand"""
    router: Annotated[str, Field(pattern=r"^(tcp|tls)/\S+:\d+$")] | None = None
    """address of a router, `tls/192.0.2.1:7447`: all processes are its clients
    ([deploy.md](../deploy.md#topologies))"""
    keys: Annotated[str, Field(pattern=r"^[^\x00]*$")] | None = None
    """folder of certificates, relative to the current folder: TLS and access control on every link
    ([access.md](../access.md#access-control))"""
    insecure: bool = False
    """true: listen unencrypted on an address that other hosts can reach"""
    vehicle_port: Annotated[int, Interval(ge=1024, le=65_000)] | None = None
    """with `plant.autopilot`, UDP port of the link to the autopilot of UAV 1, then UAV 2, ... Default:
    free ports, or 14550 with processes started by hand"""
    secret: bool = True
    """false: any local process can connect to a run without `keys` and `router`, also without its
    random secret ([access.md](../access.md#a-run-on-one-host))"""


class Scenario(Section):
    """The whole description of a run."""

    schema_version: Annotated[Literal[1], Field(alias="schema")] = 1
    """version of this format"""
    name: Annotated[
        str,
        Field(pattern=rf"^[A-Za-z0-9_-]{{1,{LONGEST_NAME}}}$"),
        Key(type=f"text: letters, digits, `_`, `-`; at most {LONGEST_NAME}"),
    ]
    """name of the run, part of every network key and of the run folder"""
    seed: Annotated[int, Interval(ge=0, lt=2**63), Key(type="integer >= 0", short="seed")] = 0
    """seed of all random numbers of a run: `[links]`, `[radio]`, wind and noise"""
    system: SystemSection
    maneuver: ManeuverSection
    obstacle: Annotated[list[ObstacleSection], Key(short="obstacles")] = []
    controller: ControllerSection = ControllerSection()
    agents: AgentsSection = AgentsSection()
    clock: ClockSection = ClockSection()
    links: LinksSection = LinksSection()
    radio: RadioSection | None = None
    faults: FaultsSection = FaultsSection()
    plant: PlantSection = PlantSection()
    vehicles: VehiclesSection = VehiclesSection()
    network: NetworkSection = NetworkSection()

    @property
    def has_plant(self) -> bool:
        """Return whether a process simulates the team."""
        return self.plant.kind == "simulated"

    @property
    def has_vehicles(self) -> bool:
        """Return whether each UAV has a process that measures and acts by an autopilot."""
        return not self.has_plant or self.plant.autopilot is not None

    @property
    def owned(self) -> tuple[tuple[int, ...], ...]:
        """Return the UAV ids of agent 1, agent 2, ...; those of `Setup.owned` count from 0."""
        if self.agents.owned is None:
            return tuple((uav.id,) for uav in self.system.uav)
        return tuple(tuple(sorted(group)) for group in self.agents.owned)

    @property
    def controllers(self) -> tuple[str, ...]:
        """Return the controllers of agent 1, agent 2, ..."""
        given = self.agents.controller
        return (given,) * len(self.owned) if isinstance(given, str) else tuple(given)

    def tree(self) -> dict[str, Any]:
        """Return the scenario as plain data with every default, to write it, and for the digest."""
        return self.model_dump(mode="json", by_alias=True, exclude_none=True)

    def digest(self) -> str:
        """Return the fingerprint of everything but network addresses, equal in all processes."""
        tree = {key: value for key, value in self.tree().items() if key != "network"}
        return hashlib.sha256(json.dumps(tree, sort_keys=True).encode()).hexdigest()[:12]
