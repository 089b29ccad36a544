"""The scenario: one validated tree that describes a run. Units are in the names; ids are 1-based.

Every process of a run reads the same file; keys.toml has unit and meaning of each key for people.
"""

import hashlib
import json
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from model.maneuver import PhaseKind, Profile
from model.parameters import GRAVITY
from mpc.settings import (
    Constraint,
    ControllerSettings,
    CostTerm,
    DiscretisationName,
    Horizon,
    Limits,
    NotNegative,
    Positive,
    PredictionName,
    Separation,
    SolverName,
    TerminalName,
    Tilt,
    Weights,
)
from protocol.scenario.link_sections import LinksSection
from protocol.scenario.plant_sections import PlantSection
from protocol.scenario.sections import Section, SettingsSection, Vector, like
from protocol.wire.messages import MAX_HORIZON, MAX_NEGOTIATION_ITERATIONS
from protocol.wire.names import MAX_UAVS


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

    id: Annotated[int, Field(ge=1, le=MAX_UAVS)]
    mass_kg: Positive
    inertia_kgm2: Inertia
    rho_m: Vector
    rod_length_m: Positive


class SystemSection(Section):
    """The physical system."""

    gravity_mps2: Positive = GRAVITY
    payload: PayloadSection
    uav: Annotated[list[UavSection], Field(min_length=1, max_length=MAX_UAVS)]


class PhaseSection(Section):
    """One piece of the payload's path; displacement in the inertial frame, z down.

    Once its `file` is read, a phase has the table in `way`, and takes duration and displacement from it.
    """

    name: str
    duration_s: Positive
    displacement_m: Vector
    kind: PhaseKind = "move"
    way: list[list[float]] | None = None
    file: str | None = None


class ManeuverSection(Section):
    """Path of the payload."""

    start_m: Vector = [0.0, 0.0, -10.0]
    profile: Profile = "ramp"
    press_m: NotNegative = 0.2
    phase: Annotated[list[PhaseSection], Field(min_length=1)]


@like(Weights)
class WeightsSection(SettingsSection):
    """Diagonal weights of the cost."""


@like(Limits)
class LimitsSection(SettingsSection):
    """Actuator limits."""


@like(Separation)
class SeparationSection(SettingsSection):
    """Smallest distance between any two UAVs."""


@like(Tilt)
class TiltSection(SettingsSection):
    """Largest roll and pitch an agent plans for its UAVs."""


@like(Constraint)
class ConstraintSection(SettingsSection):
    """A constraint of the user."""


@like(CostTerm)
class CostSection(SettingsSection):
    """A cost term of the user."""


class DisturbanceSection(Section):
    """Estimate of a constant force on the payload, compensated by the controller."""

    estimate: bool = False
    time_constant_s: Positive = 1.0


# Source of the controller's defaults.
_DEFAULT = ControllerSettings()


class ControllerSection(Section):
    """The controller of every agent."""

    sampling_period_s: Positive = _DEFAULT.sampling_period_s
    horizon: Annotated[Horizon, Field(le=MAX_HORIZON)] = _DEFAULT.horizon
    prediction: PredictionName = _DEFAULT.prediction
    terminal: TerminalName = _DEFAULT.terminal
    preview: bool = _DEFAULT.preview
    received_plans: Literal["by_age", "by_one", "held"] = "by_age"
    received_states: Literal["predicted", "as_received"] = "predicted"
    discretisation: DiscretisationName = _DEFAULT.discretisation
    negotiation_iterations: Annotated[int, Field(ge=1, le=MAX_NEGOTIATION_ITERATIONS)] = 1
    relaxation: Annotated[float | str, AfterValidator(_relaxation)] = _DEFAULT.relaxation
    solver: SolverName = _DEFAULT.solver
    motor_lag_s: NotNegative = _DEFAULT.motor_lag_s
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
    """UAVs each agent owns; agent 1 owns the first list. One agent for each UAV by default."""

    owned: Annotated[list[Annotated[list[int], Field(min_length=1)]], Field(min_length=1)] | None = None


class ClockSection(Section):
    """Sampling clock and membership."""

    mode: Literal["lockstep", "realtime"] = "lockstep"
    speed: NotNegative = 0.0
    actuation: Literal["immediate", "next_tick"] | None = None
    exchange: Literal["relayed", "direct"] | None = None
    barrier_timeout_s: Positive = 5.0
    join_timeout_s: Positive = 30.0
    on_agent_loss: Literal["abort", "continue"] = "abort"
    on_overrun: Literal["continue", "hold", "abort"] = "continue"
    overrun_limit: Annotated[int, Field(ge=0)] = 0
    overrun_limit_s: Positive | None = None

    @property
    def next_tick(self) -> bool:
        """Return whether inputs act one tick after their state, as on hardware; always so in real time."""
        return self.mode == "realtime" if self.actuation is None else self.actuation == "next_tick"

    @property
    def relayed(self) -> bool:
        """Return whether the coordinator hands on the agents' plans with the next tick; never so in real time."""
        return self.mode == "lockstep" and self.exchange != "direct"


class FaultSection(Section):
    """Fault of a process or a UAV at an instant of the run."""

    at_s: NotNegative
    do: Literal["kill", "stop", "continue", "restart", "motor_off", "release", "degrade"]
    target: str
    efficiency: Annotated[float, Field(gt=0.0, le=1.0)] | None = None


class FaultsSection(Section):
    """Scripted faults."""

    event: list[FaultSection] = []


class NetworkSection(Section):
    """Addresses of the processes: the coordinator listens on the base port, the plant one above, agents above that.

    They belong to one host, so they are not in the digest.
    """

    host: Annotated[str, Field(pattern=r"^[A-Za-z0-9_:%-]{1,63}(\.[A-Za-z0-9_:%-]{1,63}){0,9}$")] = "127.0.0.1"
    base_port: Annotated[int, Field(ge=1024, le=65_000)] | None = None
    router: str | None = None
    keys: Annotated[str, Field(pattern=r"^[^\x00]*$")] | None = None
    insecure: bool = False
    secret: bool = True


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
