"""Settings of a controller: rates, horizon, weights, limits."""

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
from annotated_types import Interval

from model.arrays import Array

SolverName = Literal["daqp", "clarabel"]
PredictionName = Literal["open_loop", "closed_loop"]
TerminalName = Literal["multiple", "riccati"]
DiscretisationName = Literal["exact", "euler"]
PenalisedInput = Literal["deviation", "absolute"]

# Limits stand here alone: settings check them, and the scenario's schema is built from them.
Positive = Annotated[float, Interval(gt=0.0)]
NotNegative = Annotated[float, Interval(ge=0.0)]
Horizon = Annotated[int, Interval(ge=1)]


class SettingsError(ValueError):
    """A setting out of its range; the text names it, what was expected and what came."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Weights:
    """The diagonal weights of the cost (docs/equations.md (21)).

    Attributes:
        position: On each UAV position error, 1/m^2.
        attitude: On payload roll, pitch, yaw, 1/rad^2.
        yaw_rate: On each UAV yaw rate, s^2/rad^2.
        payload_position: On the payload's position error, 1/m^2.
        payload_velocity: On the payload's velocity error, s^2/m^2.
        terminal: Q_f as a multiple of Q, with a terminal cost of that kind.
        thrust: 1/N^2.
        moments: About the UAV's body axes, (3,), 1/(N m)^2.
        penalised_input: R weighs the input's deviation from hover, or the input itself as in paper (17).
    """

    position: Positive = 1.0
    attitude: Positive = 5.0
    yaw_rate: Positive = 0.05
    payload_position: NotNegative = 0.0
    payload_velocity: NotNegative = 0.0
    terminal: NotNegative = 5.0
    thrust: Positive = 1e-3
    moments: tuple[Positive, Positive, Positive] = (1e-2, 1e-2, 1e-2)
    penalised_input: PenalisedInput = "deviation"

    def Q(self, N: int) -> Array:
        """Return the diagonal of Q for N UAVs, (4 N + 9,)."""
        weights = (self.position, self.attitude, self.yaw_rate, self.payload_position, self.payload_velocity)
        return np.repeat(weights, [3 * N, 3, N, 3, 3])

    def R(self, N: int) -> Array:
        """Return the diagonal of R for N UAVs, (4 N,)."""
        return np.tile([self.thrust, *self.moments], N)


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """The actuator limits, the same for every UAV.

    Attributes:
        thrust_N: Smallest and largest thrust.
        moments_Nm: Largest moment about each body axis, either sign, (3,).
        thrust_rate_N_s: Largest change of thrust per second.
        moment_rates_Nm_s: Largest change of each moment per second, (3,).
    """

    thrust_N: tuple[NotNegative, NotNegative] = (0.0, 45.0)
    moments_Nm: tuple[Positive, Positive, Positive] = (1.0, 1.0, 0.5)
    thrust_rate_N_s: Positive = 100.0
    moment_rates_Nm_s: tuple[Positive, Positive, Positive] = (10.0, 10.0, 5.0)

    def __post_init__(self) -> None:
        low, high = self.thrust_N
        if not 0.0 <= low < high < np.inf:
            raise SettingsError(f"thrust_N: expected 0 <= smallest < largest, got {list(self.thrust_N)}")
        _check(self)

    def lower(self, uavs: int) -> Array:
        """Return the smallest inputs of that many UAVs, (4 uavs,)."""
        return np.tile([self.thrust_N[0], *(-value for value in self.moments_Nm)], uavs)

    def upper(self, uavs: int) -> Array:
        """Return the largest inputs of that many UAVs, (4 uavs,)."""
        return np.tile([self.thrust_N[1], *self.moments_Nm], uavs)

    def step(self, uavs: int, period_s: float) -> Array:
        """Return the largest change of the inputs over one sampling period, (4 uavs,)."""
        return np.tile([self.thrust_rate_N_s, *self.moment_rates_Nm_s], uavs) * period_s


@dataclass(frozen=True, slots=True, kw_only=True)
class Separation:
    """The smallest distance between the centres of any two UAVs, softened so that no state makes the QP infeasible.

    Attributes:
        minimum_m: m.
        penalty: Weight of the largest violation over the horizon, per metre. Above the constraint's
            multiplier the softened problem has the solution of the hard one if that exists.
    """

    minimum_m: Positive
    penalty: Positive = 100.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Tilt:
    """The largest roll and pitch that an agent plans for its UAVs, softened so that no state makes the QP infeasible.

    It keeps a UAV far off its reference from angles at which the linearisation is not valid.

    Attributes:
        limit_deg: Either sign, deg.
        penalty: Weight of the largest violation over the horizon, per radian.
    """

    limit_deg: Annotated[float, Interval(gt=0.0, lt=90.0)]
    penalty: Positive = 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Constraint:
    """A constraint of the user as text over the model's variables (see `mpc.expressions`).

    Attributes:
        expression: Such as "r0[2] <= -2" or "thrust1 + thrust2 <= 60".
        soft: Soften a state inequality with a slack of its own; equalities stay hard.
        penalty: Weight per unit of the largest violation over the horizon. Every agent corrects the whole
            violation it predicts: use `relaxation` where the constraint becomes active.
    """

    expression: str
    soft: bool = True
    penalty: Positive = 1000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class CostTerm:
    """A cost term of the user: weight times the square of an expression, at every step of the horizon.

    Attributes:
        expression: Of states, zero without cost, such as "e1[0]" (see `mpc.expressions`).
        weight: Per square of its unit; at the last step `Weights.terminal` times as much.
    """

    expression: str
    weight: Positive


@dataclass(frozen=True, slots=True, kw_only=True)
class ControllerSettings:
    """All settings of one controller.

    Attributes:
        sampling_period_s: T_s.
        horizon: N_p, in sampling periods.
        prediction: Of the other UAVs: by the inputs they announced ("open_loop", the paper), or by
            the shared control law and the corrections they announced ("closed_loop").
        terminal: Cost of the last state: a multiple of the stage cost ("multiple", the paper), or the infinite-horizon
            cost-to-go of the team's linear-quadratic regulator ("riccati").
        preview: The regulator, and with it the shared control law and the cost-to-go, uses the reference ahead.
        discretisation: Exact zero-order hold, or one step of Euler's method for comparison.
        relaxation: w in (0, 1]; the published plan is w U* + (1 - w) U_shifted, in closed loop the same of the
            corrections.
        solver: First choice; Clarabel takes over when the residual check fails.
        motor_lag_s: Time constant of the motors that the controller predicts with; 0: inputs act at once.
    """

    sampling_period_s: Positive = 0.05
    horizon: Horizon = 20
    weights: Weights = field(default_factory=Weights)
    limits: Limits = field(default_factory=Limits)
    separation: Separation | None = None
    tilt: Tilt | None = None
    constraints: tuple[Constraint, ...] = ()
    costs: tuple[CostTerm, ...] = ()
    prediction: PredictionName = "open_loop"
    terminal: TerminalName = "multiple"
    preview: bool = False
    discretisation: DiscretisationName = "exact"
    relaxation: Annotated[float, Interval(gt=0.0, le=1.0)] = 1.0
    solver: SolverName = "daqp"
    motor_lag_s: NotNegative = 0.0

    def __post_init__(self) -> None:
        _check(self)


def _check(settings: object) -> None:
    """Check settings against the limits and choices in the types of their fields.

    Raises: SettingsError: naming the field, what was expected and what came.
    """
    for name, hint in get_type_hints(type(settings), include_extras=True).items():
        value = getattr(settings, name)
        is_tuple = get_origin(hint) is tuple
        entry = get_args(hint)[0] if is_tuple else hint
        if get_origin(entry) is Literal and value not in get_args(entry):
            raise SettingsError(f"{name}: expected one of {', '.join(get_args(entry))}, got {value!r}")
        if get_origin(entry) is Annotated:
            kind, limits = get_args(entry)
            if not all(_is_within(one, kind, limits) for one in (value if is_tuple else (value,))):
                noun = "an integer" if kind is int else "numbers" if is_tuple else "a number"
                got = list(value) if is_tuple else value
                raise SettingsError(f"{name}: expected {noun} {_range(limits)}, got {got}")


def _is_within(value: Any, kind: type, limits: Any) -> bool:
    if (kind is int and not isinstance(value, int)) or not np.isfinite(value):
        return False
    above = value >= limits.ge if limits.gt is None else value > limits.gt
    return bool(above and (limits.le is None or value <= limits.le) and (limits.lt is None or value < limits.lt))


def _range(limits: Any) -> str:
    """Return limits as text, such as ">= 1" or "in (0, 1]"."""
    if limits.le is limits.lt is None:
        return f">= {limits.ge:g}" if limits.gt is None else f"> {limits.gt:g}"
    low = f"[{limits.ge:g}" if limits.gt is None else f"({limits.gt:g}"
    return f"in {low}, {limits.lt:g})" if limits.le is None else f"in {low}, {limits.le:g}]"
