"""Settings: each one out of its range is refused."""

from dataclasses import replace
from math import nan
from typing import Any, Literal

import numpy as np
import pytest

from tests.support.systems import changed
from transport.model.physics.parameters import table_1
from transport.model.section import Section
from transport.model.state import StateView
from transport.mpc.program.user_expressions import UserCosts
from transport.mpc.settings_period_horizon_weights import ControllerSettings, Limits, Weights

BAD: list[tuple[type[Section], dict[str, Any]]] = [
    (Limits, {"thrust_N": (-1.0, 45.0)}),
    (Limits, {"thrust_N": (45.0, 45.0)}),
    (Limits, {"thrust_N": (50.0, 45.0)}),
    (Limits, {"thrust_N": (nan, 45.0)}),
    (Limits, {"thrust_N": (0.0, nan)}),
    (Limits, {"moments_Nm": (1.0, 0.0, 1.0)}),
    (Limits, {"moments_Nm": (1.0, 1.0, nan)}),
    (Limits, {"moment_rates_Nm_s": (1.0, 1.0, 0.0)}),
    (Limits, {"rates_rads": (1.0, 0.0, 1.0)}),
    (Limits, {"rate_slopes_rads2": (1.0, 1.0, 0.0)}),
    (Limits, {"thrust_rate_N_s": nan}),
    (ControllerSettings, {"horizon": 0}),
    (ControllerSettings, {"sampling_period_s": -0.05}),
    (ControllerSettings, {"relaxation": 0.0}),
    (ControllerSettings, {"relaxation": 1.01}),
    (ControllerSettings, {"relaxation": nan}),
]


@pytest.mark.parametrize(("make", "fields"), BAD, ids=lambda value: str(value)[:50])
def test_bad_setting_is_refused(make: type[Section], fields: dict[str, Any]) -> None:
    """A setting out of its range, or no number, never becomes a controller; the error names it."""
    with pytest.raises(ValueError, match=next(iter(fields))):
        make(**fields)


def test_order_of_the_weights() -> None:
    """Q follows y of (14), without weight on the payload's way by default.

    R follows u, per UAV thrust and moments.
    """
    Q = Weights(
        position=1.0, attitude=2.0, yaw_rate=3.0, payload_position=4.0, payload_velocity=5.0
    ).Q(2)
    assert Q.tolist() == [1.0] * 6 + [2.0] * 3 + [3.0] * 2 + [4.0] * 3 + [5.0] * 3
    assert not Weights().Q(3)[-6:].any()
    assert (
        Weights(thrust=1.0, moments=(2.0, 3.0, 4.0)).R(table_1()).tolist()
        == [1.0, 2.0, 3.0, 4.0] * 4
    )


def test_weights_on_accelerations_by_hand() -> None:
    """Weights over the squares of what a UAV lifts, with an equal share of the payload, and of its inertia, (21a).

    With commanded body rates their weights take the place of those on turning.
    """
    bodies = table_1()
    light = replace(bodies.uavs[1], mass=1.0, inertia=np.diag([0.02, 0.03, 0.04]))
    system = replace(bodies, uavs=(bodies.uavs[0], light, *bodies.uavs[2:]))
    weights = Weights(acceleration=7.0, angular_acceleration=6e-4, rates=(2.0, 3.0, 4.0))
    thrust = 7.0 / (1.0 + 3.0 / 4) ** 2
    assert weights.R(system)[4:8] == pytest.approx([thrust, 1.5, 6e-4 / 0.03**2, 0.375])
    by_rates = replace(system, rate_gains=np.ones(3))
    assert weights.R(by_rates)[4:8] == pytest.approx([thrust, 2.0, 3.0, 4.0])


def test_tilt_rate_weighs_the_first_two_body_rates_of_each_uav() -> None:
    """The terms (48) of a state sum up to the weight on the squares of all tilt rates."""
    system = table_1()
    weight = 2.5
    x = np.random.default_rng(0).standard_normal(system.n)
    terms = Weights(tilt_rate=weight).terms(system.N)
    values, _ = UserCosts(terms, system).at(x)
    cost = sum(term.weight * value**2 for term, value in zip(terms, values, strict=True))
    tilt_rates = StateView(x).omega_B[:, :2]
    assert cost == pytest.approx(weight * (tilt_rates**2).sum())
    assert Weights(tilt_rate=0.0).terms(system.N) == ()


@pytest.mark.parametrize("inputs", ["moments", "rates"])
def test_limits_per_uav(inputs: Literal["moments", "rates"]) -> None:
    """Bounds and rates repeat per UAV in the order of u, for moments or commanded body rates.

    Both are bounded either way, their changes per period.
    """
    turning, slopes = (1.0, 2.0, 3.0), (4.0, 8.0, 16.0)
    thrust = Limits(thrust_N=(2.0, 30.0), thrust_rate_N_s=80.0)
    if inputs == "rates":
        limits = changed(thrust, rates_rads=turning, rate_slopes_rads2=slopes)
    else:
        limits = changed(thrust, moments_Nm=turning, moment_rates_Nm_s=slopes)
    settings = ControllerSettings(limits=limits, sampling_period_s=0.25, inputs=inputs)
    assert settings.lower(2).tolist() == [2.0, -1.0, -2.0, -3.0] * 2
    assert settings.upper(2).tolist() == [30.0, 1.0, 2.0, 3.0] * 2
    assert settings.largest_step(2).tolist() == [20.0, 1.0, 2.0, 4.0] * 2
