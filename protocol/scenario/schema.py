"""The scenario: one validated tree that describes a run. Units are in the names; ids are 1-based.

Every process of a run reads the same file; docs/scenario.md describes each key for people.
"""

import hashlib
import json
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, SerializerFunctionWrapHandler, model_serializer
from pydantic_core import PydanticCustomError


class Section(BaseModel):
    """Part of a scenario: unknown keys are refused, values never change after reading."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Probability = Annotated[float, Field(ge=0.0, le=1.0)]
MassFactor = Annotated[float, Field(gt=0.0, le=100.0)]


def _three_numbers(value: list[float]) -> list[float]:
    if len(value) != 3:
        raise PydanticCustomError("shape", "expected 3 numbers")
    return value


Vector = Annotated[list[float], AfterValidator(_three_numbers)]
PositiveVector = Annotated[list[Positive], AfterValidator(_three_numbers)]
NotNegativeVector = Annotated[list[NotNegative], AfterValidator(_three_numbers)]


def _inertia(value: Any) -> Any:
    try:
        shape = np.shape(np.asarray(value, dtype=np.float64))
    except (TypeError, ValueError):
        shape = None
    if shape not in ((3,), (3, 3)):
        raise PydanticCustomError("shape", "expected 3 principal moments or 3 rows of 3 numbers")
    return value


def _relaxation(value: float | str) -> float | str:
    if value == "auto" or (isinstance(value, float | int) and 0.0 < value <= 1.0):
        return value
    raise PydanticCustomError("relaxation", "expected a number in (0, 1] or 'auto'")


Inertia = Annotated[list[float] | list[list[float]], AfterValidator(_inertia)]


class PayloadSection(Section):
    """The carried body."""

    mass_kg: Positive
    inertia_kgm2: Inertia


class UavSection(Section):
    """One UAV and its rod."""

    id: Annotated[int, Field(ge=1, le=256)]
    mass_kg: Positive
    inertia_kgm2: Inertia
    rho_m: Vector
    rod_length_m: Positive


class SystemSection(Section):
    """The physical system."""

    gravity_mps2: Positive = 9.81
    payload: PayloadSection
    uav: Annotated[list[UavSection], Field(min_length=1, max_length=256)]


class PhaseSection(Section):
    """One piece of the payload's path; displacement in the inertial frame, z down.

    A phase with a `file` has its table in `way`, and duration and displacement from it, once it has been read.
    """

    name: str
    duration_s: Positive
    displacement_m: Vector
    way: list[list[float]] | None = None
    file: str | None = None


class ManeuverSection(Section):
    """What is flown."""

    start_m: Vector = [0.0, 0.0, -10.0]
    profile: Literal["ramp", "min_jerk", "step"] = "ramp"
    phase: Annotated[list[PhaseSection], Field(min_length=1)]


class WeightsSection(Section):
    """Diagonal weights of the cost."""

    position: Positive = 1.0
    attitude: Positive = 5.0
    yaw_rate: Positive = 0.05
    payload_position: NotNegative = 0.0
    payload_velocity: NotNegative = 0.0
    terminal: NotNegative = 5.0
    thrust: Positive = 1e-3
    moments: PositiveVector = [1e-2, 1e-2, 1e-2]
    penalised_input: Literal["deviation", "absolute"] = "deviation"


class LimitsSection(Section):
    """Actuator limits."""

    thrust_N: Annotated[list[NotNegative], Field(min_length=2, max_length=2)] = [0.0, 45.0]
    moments_Nm: PositiveVector = [1.0, 1.0, 0.5]
    thrust_rate_N_s: Positive = 100.0
    moment_rates_Nm_s: PositiveVector = [10.0, 10.0, 5.0]


class SeparationSection(Section):
    """Smallest distance between any two UAVs."""

    minimum_m: Positive
    penalty: Positive = 100.0


class TiltSection(Section):
    """Largest roll and pitch an agent plans for its UAVs."""

    limit_deg: Annotated[float, Field(gt=0.0, lt=90.0)]
    penalty: Positive = 10.0


class ConstraintSection(Section):
    """A constraint of the user's own."""

    expression: str
    soft: bool = True
    penalty: Positive = 1000.0


class CostSection(Section):
    """A term of the cost of the user's own."""

    expression: str
    weight: Positive


class DisturbanceSection(Section):
    """Estimate of a constant force on the payload, and whether the controller allows for it."""

    estimate: bool = False
    time_constant_s: Positive = 1.0


class ControllerSection(Section):
    """The controller every agent runs."""

    sampling_period_s: Positive = 0.05
    horizon: Annotated[int, Field(ge=1, le=10_000)] = 20
    prediction: Literal["open_loop", "closed_loop"] = "open_loop"
    terminal: Literal["multiple", "riccati"] = "multiple"
    preview: bool = False
    received_plans: Literal["by_age", "by_one", "held"] = "by_age"
    received_states: Literal["predicted", "as_received"] = "predicted"
    discretisation: Literal["exact", "euler"] = "exact"
    negotiation_iterations: Annotated[int, Field(ge=1, le=20)] = 1
    relaxation: Annotated[float | str, AfterValidator(_relaxation)] = 1.0
    solver: Literal["daqp", "clarabel"] = "daqp"
    share: Literal["always", "on_change"] = "always"
    share_threshold: NotNegative = 0.01
    share_heartbeat_s: Positive = 1.0
    weights: WeightsSection = WeightsSection()
    limits: LimitsSection = LimitsSection()
    separation: SeparationSection | None = None
    tilt: TiltSection | None = None
    constraint: list[ConstraintSection] = []
    cost: list[CostSection] = []
    disturbance: DisturbanceSection = DisturbanceSection()


class AgentsSection(Section):
    """Which agent decides for which UAVs; agent 1 owns the first list. One agent for each UAV by default."""

    owned: Annotated[list[Annotated[list[int], Field(min_length=1)]], Field(min_length=1)] | None = None


class ClockSection(Section):
    """Sampling clock and membership."""

    mode: Literal["lockstep", "realtime"] = "lockstep"
    speed: NotNegative = 0.0
    actuation: Literal["immediate", "next_tick"] | None = None
    barrier_timeout_s: Positive = 5.0
    join_timeout_s: Positive = 30.0
    on_agent_loss: Literal["abort", "continue"] = "abort"
    on_overrun: Literal["continue", "hold", "abort"] = "continue"
    overrun_limit: Annotated[int, Field(ge=0)] = 0
    overrun_limit_s: Positive | None = None

    @property
    def next_tick(self) -> bool:
        """Whether inputs act one tick after the state they are for: what hardware can do, and always in real time."""
        return self.mode == "realtime" if self.actuation is None else self.actuation == "next_tick"


class GilbertElliottSection(Section):
    """Bursts of loss: a chain between a good state without and a bad state with loss, one step per tick."""

    enter: Probability
    leave: Probability
    loss: Probability = 1.0


class LinkSection(Section):
    """What a link does to the messages it carries."""

    delay_s: NotNegative = 0.0
    jitter_s: NotNegative = 0.0
    distribution: Literal["uniform", "normal", "exponential", "lognormal", "empirical"] = "uniform"
    samples: str | None = None
    loss: Probability = 0.0
    gilbert_elliott: GilbertElliottSection | None = None
    duplicate: Probability = 0.0
    reorder: Probability = 0.0
    reorder_s: NotNegative = 0.0
    rate_hz: Positive | None = None

    @property
    def perfect(self) -> bool:
        """Return whether every message arrives at once, once."""
        return all(getattr(self, key) == field.default for key, field in LinkSection.model_fields.items())

    def settings(self) -> dict[str, Any]:
        """Return the keys of a link that were given, as plain data."""
        given = self.model_dump(mode="json", exclude_unset=True)
        return {key: value for key, value in given.items() if key in LinkSection.model_fields}


class LinkOverrideSection(LinkSection):
    """The same for the links from and to one process; leaving one out means any agent."""

    from_: Annotated[str | None, Field(alias="from")] = None
    to: str | None = None

    def covers(self, sender: str, receiver: str) -> bool:
        """Whether it concerns the link from one process to another; the plant has to be named."""
        ends = ((self.from_, sender), (self.to, receiver))
        return all(name == end if name is not None else end != "plant" for name, end in ends)


class LinkChangeSection(LinkOverrideSection):
    """Changes links in flight: what is sent from `at_s` on is treated by the keys given, the others stay."""

    at_s: NotNegative

    @model_serializer(mode="wrap")
    def _given(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Only what was given: a default written out would be a change."""
        given = {*self.model_fields_set, *({"from"} if "from_" in self.model_fields_set else ())}
        return {key: value for key, value in dump(self).items() if key in given}


class PartitionSection(Section):
    """An interval in which the processes named hear nothing of the agents that are not, nor those of them."""

    between: Annotated[list[str], Field(min_length=1)]
    start_s: NotNegative
    end_s: Positive


class LinksSection(LinkSection):
    """The links between agents; measurement and actuation are those from and to the plant, ideal by default."""

    measurement: LinkSection = LinkSection()
    actuation: LinkSection = LinkSection()
    override: list[LinkOverrideSection] = []
    partition: list[PartitionSection] = []
    change: list[LinkChangeSection] = []

    def all(self) -> dict[str, LinkSection]:
        """Every section of a link by its place below `links`, such as "override.1"."""
        overrides = {f"override.{i}": section for i, section in enumerate(self.override, start=1)}
        changes = {f"change.{i}": section for i, section in enumerate(self.change, start=1)}
        return {"": self, "measurement": self.measurement, "actuation": self.actuation, **overrides, **changes}


class FaultSection(Section):
    """Something done to a process or a UAV at an instant of the flight."""

    at_s: NotNegative
    do: Literal["kill", "stop", "continue", "restart", "motor_off", "release"]
    target: str


class FaultsSection(Section):
    """Scripted faults."""

    event: list[FaultSection] = []


class WindSection(Section):
    """Moving air, inertial frame, and the drag of the bodies in it."""

    speed_mps: Vector = [0.0, 0.0, 0.0]
    gust_mps: NotNegativeVector = [0.0, 0.0, 0.0]
    gust_time_constant_s: Positive = 2.0
    drag_payload_kgps: NotNegative = 0.4
    drag_uav_kgps: NotNegative = 0.2


class NoiseSection(Section):
    """Standard deviations of the measurements."""

    position_m: NotNegative = 0.0
    velocity_mps: NotNegative = 0.0
    attitude_rad: NotNegative = 0.0
    rate_rads: NotNegative = 0.0
    rod_direction_rad: NotNegative = 0.0
    rod_rate_rads: NotNegative = 0.0


class PlantSection(Section):
    """The truth: its integration, how it differs from what the controller knows, when a flight counts as lost."""

    step_s: Positive = 0.01
    max_attitude_deg: Annotated[float, Field(gt=0.0, lt=90.0)] = 80.0
    max_error_m: Positive = 20.0
    payload_mass_factor: MassFactor = 1.0
    uav_mass_factor: MassFactor = 1.0
    wind: WindSection = WindSection()
    noise: NoiseSection = NoiseSection()


class NetworkSection(Section):
    """Where processes listen: the coordinator on the base port, the plant one above, agents above that.

    All of it is about one host, so none of it is in the digest.
    """

    host: str = "127.0.0.1"
    base_port: Annotated[int, Field(ge=1024, le=65_000)] | None = None
    router: str | None = None
    keys: str | None = None
    insecure: bool = False


class Scenario(Section):
    """The whole description of a run."""

    schema_version: Annotated[Literal[1], Field(alias="schema")] = 1
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,40}$")]
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    system: SystemSection
    maneuver: ManeuverSection
    controller: ControllerSection = ControllerSection()
    agents: AgentsSection = AgentsSection()
    clock: ClockSection = ClockSection()
    links: LinksSection = LinksSection()
    faults: FaultsSection = FaultsSection()
    plant: PlantSection = PlantSection()
    network: NetworkSection = NetworkSection()

    @property
    def owned(self) -> tuple[tuple[int, ...], ...]:
        """UAV ids of agent 1, agent 2, ..."""
        if self.agents.owned is None:
            return tuple((uav.id,) for uav in self.system.uav)
        return tuple(tuple(sorted(group)) for group in self.agents.owned)

    def tree(self) -> dict[str, Any]:
        """As plain data, every default spelled out, for writing back and for the digest."""
        return self.model_dump(mode="json", by_alias=True, exclude_none=True)

    def digest(self) -> str:
        """Fingerprint of everything but the network addresses: processes of one run must agree on it."""
        tree = {key: value for key, value in self.tree().items() if key != "network"}
        return hashlib.sha256(json.dumps(tree, sort_keys=True).encode()).hexdigest()[:12]
