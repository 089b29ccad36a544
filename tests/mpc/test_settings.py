"""Settings: each one out of its range is refused."""

from math import nan
from typing import Any

import pytest

from transport.model.parameters import table_1
from transport.mpc.settings import ControllerSettings, Limits, Section, Weights

BAD: list[tuple[type[Section], dict[str, Any]]] = [
    (Limits, {"thrust_N": (-1.0, 45.0)}),
    (Limits, {"thrust_N": (45.0, 45.0)}),
    (Limits, {"thrust_N": (50.0, 45.0)}),
    (Limits, {"thrust_N": (nan, 45.0)}),
    (Limits, {"thrust_N": (0.0, nan)}),
    (Limits, {"moments_Nm": (1.0, 0.0, 1.0)}),
    (Limits, {"moments_Nm": (1.0, 1.0, nan)}),
    (Limits, {"moment_rates_Nm_s": (1.0, 1.0, 0.0)}),
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


def test_limits_per_uav() -> None:
    """Bounds and rates repeat per UAV in the order of u.

    Moments are bounded either way, rates per period.
    """
    limits = Limits(
        thrust_N=(2.0, 30.0),
        moments_Nm=(1.0, 2.0, 3.0),
        thrust_rate_N_s=80.0,
        moment_rates_Nm_s=(4.0, 8.0, 16.0),
    )
    settings = ControllerSettings(limits=limits, sampling_period_s=0.25)
    assert settings.lower(2).tolist() == [2.0, -1.0, -2.0, -3.0] * 2
    assert settings.upper(2).tolist() == [30.0, 1.0, 2.0, 3.0] * 2
    assert settings.largest_step(2).tolist() == [20.0, 1.0, 2.0, 4.0] * 2
