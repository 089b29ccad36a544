"""Settings of a controller.

Each key of the controller has its type, range, default and meaning here. Those that only a run has
are in `protocol.scenario.sections.schema.ControllerSection`, as are the limit of `horizon` that a message
sets, and a `relaxation` that follows from the team ("auto").
"""

from typing import Annotated, ClassVar, Literal

import numpy as np
from annotated_types import Interval
from pydantic import BeforeValidator

from transport.model.arrays import Array
from transport.model.physics.parameters import System
from transport.model.section import (
    LAG_S,
    Key,
    NotNegative,
    Positive,
    PositiveVector,
    Range,
    Section,
    as_tuple,
)

SolverName = Literal["daqp", "clarabel"]
PredictionName = Literal["open_loop", "closed_loop"]
PenalisedInput = Literal["deviation", "absolute"]


class SettingsError(ValueError):
    """A setting that a controller cannot use; the text names it, with expected and actual value."""


# Defaults that the section of a scenario shares, whose ranges are others (`ControllerSection`).
DEFAULT_HORIZON = 20
DEFAULT_RELAXATION = 1.0


def _weight_key(unit: str | None = None, label: str = "") -> Key:
    """Return the properties of a weight or penalty.

    Its range is wide. It has ends because the ratios of weights decide the condition of the QP.
    """
    return Key(unit=unit, within=(1e-12, 1e8), label=label)


class Weights(Section):
    """The diagonal weights of the cost (docs/equations.md (21))."""

    position: Annotated[Positive, _weight_key("1/m²", "weight on UAV position")] = 1.0
    """weight on each coordinate of each UAV's position error"""
    attitude: Annotated[Positive, _weight_key("1/rad²", "weight on payload attitude")] = 5.0
    """weight on payload roll, pitch, yaw"""
    yaw_rate: Annotated[Positive, _weight_key("s²/rad²", "weight on yaw rate")] = 0.05
    """weight on each UAV's third body rate"""
    payload_position: Annotated[NotNegative, _weight_key("1/m²", "weight on payload position")] = (
        0.0
    )
    """weight on each coordinate of the payload's position error"""
    payload_velocity: Annotated[NotNegative, _weight_key("s²/m²", "weight on payload velocity")] = (
        0.0
    )
    """weight on each coordinate of the payload's velocity error"""
    terminal: Annotated[NotNegative, _weight_key(label="terminal weight")] = 5.0
    """Q_f as a multiple of Q; no effect with `controller.terminal=riccati`"""
    thrust: Annotated[Positive, _weight_key("1/N²", "weight on thrust")] = 1e-3
    """weight on each thrust; no effect with `acceleration`, as in `resilient`"""
    moments: Annotated[PositiveVector, _weight_key("1/(N m)²", "weight on moments")] = (
        1e-2,
        1e-2,
        1e-2,
    )
    """weight on each moment, per body axis"""
    rates: Annotated[PositiveVector, _weight_key("s²/rad²", "weight on commanded body rates")] = (
        0.1,
        0.1,
        0.1,
    )
    """weight on each commanded body rate, per body axis; only with `controller.inputs=rates`, in
    place of `moments` and `angular_acceleration`, for vehicles of any size"""
    acceleration: Annotated[
        Positive | None, _weight_key("s⁴/m²", "weight on acceleration by thrust")
    ] = None
    """weight on the square of each thrust over the mass that the UAV lifts, its own and an equal share
    of the payload's; replaces `thrust`, so that one value serves vehicles of any size"""
    angular_acceleration: Annotated[
        Positive | None, _weight_key("s⁴/rad²", "weight on angular acceleration by moments")
    ] = None
    """weight on the square of each moment over the UAV's inertia about that axis; replaces `moments`,
    so that one value serves vehicles of any size"""
    tilt_rate: Annotated[NotNegative, _weight_key("s²/rad²", "weight on tilt rate")] = 0.0
    """weight on each UAV's first and second body rate"""
    penalised_input: PenalisedInput = "deviation"
    """argument of R: the deviation of the input from hover, or the input itself (the paper)"""

    def Q(self, N: int) -> Array:
        """Return the diagonal of Q for N UAVs, (4 N + 9,). Source: docs/equations.md (21)."""
        blocks = (  # in the order of the outputs (14)
            (self.position, 3 * N),  # r_i
            (self.attitude, 3),  # Theta_0
            (self.yaw_rate, N),  # omega_i3
            (self.payload_position, 3),  # r_0
            (self.payload_velocity, 3),  # R_0 v_0
        )
        weights, lengths = zip(*blocks, strict=True)
        return np.repeat(np.array(weights), np.array(lengths))

    def R(self, system: System) -> Array:
        """Return the diagonal of R, (4 N,).

        Thrust has the weight `acceleration`, if given, else `thrust`. Turning has `rates` with
        commanded body rates, else `angular_acceleration`, if given, else `moments`.
        Source: docs/equations.md (21), (21a).
        """
        rows = []
        for uav in system.uavs:
            thrust_weight = self.thrust
            if self.acceleration is not None:
                # R_f = w_a / (m_i + m_0 / N)^2: (21a).
                lifted = uav.mass + system.payload.mass / system.N
                thrust_weight = self.acceleration / lifted**2

            turning_weights = self.moments
            if system.commands_rates:
                turning_weights = self.rates
            elif self.angular_acceleration is not None:
                # R_tau = w_alpha / J_i^2 about each axis: (21a).
                turning_weights = tuple(self.angular_acceleration / np.diag(uav.inertia) ** 2)
            rows.append(np.array([thrust_weight, *turning_weights]))
        return np.concatenate(rows)

    def terms(self, N: int) -> tuple["CostTerm", ...]:
        """Return the weights of N UAVs on other quantities than outputs, as terms of the cost."""
        if self.tilt_rate == 0.0:
            return ()
        terms = []
        for uav in range(1, N + 1):
            for axis in (0, 1):
                rate = f"omega{uav}[{axis}]"
                terms.append(CostTerm(expression=rate, weight=self.tilt_rate))
        return tuple(terms)


class Limits(Section):
    """The actuator limits, the same for every UAV."""

    thrust_N: Range = (0.0, 45.0)
    """smallest and largest thrust; hover must lie between"""
    moments_Nm: PositiveVector = (1.0, 1.0, 0.5)
    """largest moment about each body axis, either sign; with `controller.inputs=rates` that of the
    inner loop"""
    thrust_rate_N_s: Positive = 100.0
    """largest change of thrust; over one period it is this times T_s"""
    moment_rates_Nm_s: PositiveVector = (10.0, 10.0, 5.0)
    """largest change of each moment; no effect with `controller.inputs=rates`"""
    rates_rads: PositiveVector = (4.0, 4.0, 2.0)
    """largest commanded rate about each body axis, either sign; only with
    `controller.inputs=rates`"""
    rate_slopes_rads2: PositiveVector = (40.0, 40.0, 20.0)
    """largest change of each commanded body rate; only with `controller.inputs=rates`"""


class SeparationSection(Section):
    """The smallest distance between the centres of any two UAVs.

    Softened, so that no state makes the QP infeasible.
    """

    minimum_m: Annotated[Positive, Key(label="smallest allowed distance of UAVs")]
    """smallest distance between the centres of any two UAVs; at most the distance at hover"""
    # With a penalty above the constraint's multiplier the softened problem has the solution of the
    # hard one, if there is one.
    penalty: Annotated[Positive, _weight_key("1/m")] = 100.0
    """penalty on the largest violation over the horizon"""


class TiltSection(Section):
    """The largest roll and pitch that an agent plans for its UAVs, softened.

    The linearisation is valid within them.
    """

    limit_deg: Annotated[float, Interval(gt=0.0, lt=90.0), Key(label="largest planned tilt")]
    """largest roll and pitch, either sign, that an agent plans for its own UAVs"""
    penalty: Annotated[Positive, _weight_key("1/rad")] = 10.0
    """penalty on the largest violation over the horizon"""


class TensionSection(Section):
    """The smallest rod tension that an agent plans for its UAVs, softened.

    A taut cable behaves as a rod.
    """

    minimum_N: Positive
    """smallest tension of the rods of its own UAVs that an agent plans; less than at hover"""
    penalty: Annotated[Positive, _weight_key("1/N")] = 10.0
    """penalty on the largest violation over the horizon"""


class ConstraintSection(Section):
    """A constraint of the user as text over the variables of the model (see `mpc.program.user_expressions`)."""

    expression: str
    """such as `"r0[2] >= -12.0"`"""
    soft: bool = True
    """true: a state inequality may be violated at a penalty; equalities and input constraints are
    always hard"""
    penalty: Annotated[Positive | None, _weight_key("1 over the unit of the expression")] = None
    """penalty on the largest violation over the horizon. If omitted: a slope of the team's
    tracking cost, larger for places than for speeds, [equations.md](../equations.md) (30d). A much
    steeper one lets agents with late plans correct each other"""


class CostTerm(Section):
    """A cost term of the user, at every step of the horizon.

    Weight times the square of an expression.
    """

    expression: str
    """term of the cost, such as `"v0[0]"`: of states alone; zero in the state that the team is to reach"""
    weight: Annotated[Positive, _weight_key("1 over the square of the expression's unit")]
    """weight of its square at each step of the horizon; at the last step
    `controller.weights.terminal` times as much, or the cost-to-go"""


class AloneGains(Section):
    """Gains of the control law of UAVs alone (docs/equations.md (31a), (31b)). If omitted: designed for the team.

    The limits of the law are no keys: they are the same for all teams.
    """

    # Time in which the integral forgets, s: UAVs on a rigid body could otherwise hold any force
    # against each other, which biases of their sensors would let grow.
    forgets_s: ClassVar[float] = 20.0
    # Largest change of roll and pitch that a deviation asks for.
    steepest_rad: ClassVar[float] = 0.5
    # Largest force of the integral, as a share of the hover thrust.
    largest_integral: ClassVar[float] = 0.4

    position: Annotated[Positive, Key(unit="1/s²")] = 6.0
    """acceleration per deviation of position"""
    velocity: Annotated[Positive, Key(unit="1/s")] = 5.0
    """acceleration per deviation of velocity"""
    integral: Annotated[Positive, Key(unit="1/s³")] = 2.5
    """growth of the integral's acceleration per deviation of position"""
    swing: Annotated[NotNegative, Key(unit="1/s")] = 0.5
    """acceleration per velocity of the rod's lower end relative to the UAV, for a rod of 1 m; it grows with
    the square root of the rod's length"""
    attitude_rads: Positive = 6.0
    """frequency of the attitude loop; only with `controller.inputs=moments`"""
    rates: Annotated[Positive, Key(unit="1/s")] = 10.0
    """largest gain from attitude to commanded body rates; at most half that of the inner loop; only with
    `controller.inputs=rates`"""


class ControllerSettings(Section):
    """All settings of one controller."""

    sampling_period_s: Annotated[
        Positive,
        Key(within=(1e-5, 10.0), label="sampling period", shown="ms", short="sampling_period_s"),
    ] = 0.05
    """sampling period T_s"""
    horizon: Annotated[
        int, Interval(ge=1), Key(label="horizon", shown="steps", short="horizon")
    ] = DEFAULT_HORIZON
    """prediction horizon N_p, in sampling periods"""
    prediction: Annotated[PredictionName, Key(short="prediction")] = "open_loop"
    """prediction of the others: their announced inputs (the paper), or the shared control law plus
    announced corrections"""
    linearisation: Literal["present", "along"] = "present"
    """closed_loop predicts by the linearisation about the present state, or along the trajectory
    that the shared control law would take, deviations from it by the linearisation about hover
    ([equations](../equations/law.md#prediction-along-the-control-law)). along is valid for long
    horizons and large deviations; no effect with open_loop"""
    fail_safe: Literal["level", "follow"] = "level"
    """what a UAV does without a newer plan. level: it plays its last one to the end and then keeps level.
    follow: it plays at most 0.4 s of it and then follows its part of the motion of the team alone, by its
    own position and velocity ([equations](../equations/alone.md#fail-safe))"""
    terminal: Literal["multiple", "riccati"] = "multiple"
    """cost at the end of the horizon: Q_f, or the cost-to-go of the team's linear-quadratic
    regulator, [equations.md](../equations.md) (36d). riccati needs
    `controller.weights.penalised_input=deviation`"""
    preview: bool = False
    """true: the shared control law and the cost-to-go use the reference ahead,
    [equations.md](../equations.md) (36c). true needs closed_loop or riccati"""
    discretisation: Literal["exact", "euler"] = "exact"
    """discretisation of the linearised model: zero-order hold, or one step of Euler's method for
    comparison"""
    relaxation: Annotated[float, Interval(gt=0.0, le=1.0)] = DEFAULT_RELAXATION
    """share w in (0, 1] of the new optimum in the published plan w U* + (1 - w) U_shifted"""
    solver: Annotated[SolverName, Key(short="solver")] = "daqp"
    """first QP solver; the other one solves any program whose solution fails the residual check.
    daqp: the program with bounds alone is tried first"""
    inputs: Literal["moments", "rates"] = "moments"
    """commands of agents beside the thrust: moments, or body rates that an inner loop on each UAV
    follows, [equations](../equations/plant.md#body-rates) (57)"""
    rate_time_constant_s: Annotated[
        PositiveVector,
        Key(within=LAG_S, label="time constant of the inner loop", shown="ms"),
    ] = (0.04, 0.04, 0.04)  # fmt: skip
    """time constant of the inner loop about each body axis, of controllers and plant; only with
    `inputs=rates`"""
    motor_lag_s: Annotated[
        NotNegative, Key(within=LAG_S, label="motor lag of the model", shown="ms")
    ] = 0.0
    """time constant of the motors that the controller predicts with,
    [equations](../equations/plant.md#motors) (55); 0, or at least a hundredth of T_s. The time constant
    of the plant is `plant.motors.lag_s`"""
    weights: Weights = Weights()
    limits: Limits = Limits()
    separation: SeparationSection | None = None
    tilt: TiltSection | None = None
    tension: TensionSection | None = None
    alone: AloneGains | None = None
    constraint: Annotated[tuple[ConstraintSection, ...], BeforeValidator(as_tuple)] = ()
    cost: Annotated[tuple[CostTerm, ...], BeforeValidator(as_tuple)] = ()

    @property
    def alone_gains(self) -> AloneGains:
        """Gains of UAVs alone: the given or designed ones, else the defaults."""
        return AloneGains() if self.alone is None else self.alone

    def lower(self, uavs: int) -> Array:
        """Return the smallest inputs of that many UAVs, (4 uavs,)."""
        smallest_N, _ = self.limits.thrust_N
        turning = self._largest_turning()
        of_one = [smallest_N, *(-largest for largest in turning)]
        return np.tile(of_one, uavs)

    def upper(self, uavs: int) -> Array:
        """Return the largest inputs of that many UAVs, (4 uavs,)."""
        _, largest_N = self.limits.thrust_N
        of_one = [largest_N, *self._largest_turning()]
        return np.tile(of_one, uavs)

    def largest_step(self, uavs: int) -> Array:
        """Return the largest change of the inputs over one sampling period, (4 uavs,)."""
        turning = self.limits.moment_rates_Nm_s
        if self.inputs == "rates":
            turning = self.limits.rate_slopes_rads2
        per_second = np.array([self.limits.thrust_rate_N_s, *turning] * uavs)
        return per_second * self.sampling_period_s

    def _largest_turning(self) -> tuple[float, ...]:
        """Return the largest moments, or commanded body rates, about each axis."""
        return self.limits.rates_rads if self.inputs == "rates" else self.limits.moments_Nm
