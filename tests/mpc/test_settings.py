"""Settings: each one out of its range is refused, the text says what was expected and what came."""

from collections.abc import Callable
from math import nan
from typing import Any

import numpy as np
import pytest

from mpc.settings import ControllerSettings, Limits, SettingsError, Weights

Make = Callable[..., object]

BAD: list[tuple[Make, dict[str, Any], str]] = [
    (Limits, {"thrust_N": (-1.0, 45.0)}, "thrust_N: expected 0 <= smallest < largest, got [-1.0, 45.0]"),
    (Limits, {"thrust_N": (45.0, 45.0)}, "thrust_N: expected 0 <= smallest < largest, got [45.0, 45.0]"),
    (Limits, {"thrust_N": (50.0, 45.0)}, "thrust_N: expected 0 <= smallest < largest, got [50.0, 45.0]"),
    (Limits, {"thrust_N": (nan, 45.0)}, "thrust_N: expected 0 <= smallest < largest, got [nan, 45.0]"),
    (Limits, {"thrust_N": (0.0, nan)}, "thrust_N: expected 0 <= smallest < largest, got [0.0, nan]"),
    (Limits, {"moments_Nm": (1.0, 0.0, 1.0)}, "moments_Nm: expected numbers > 0, got [1.0, 0.0, 1.0]"),
    (Limits, {"moments_Nm": (-1.0, 1.0, 1.0)}, "moments_Nm: expected numbers > 0, got [-1.0, 1.0, 1.0]"),
    (Limits, {"moment_rates_Nm_s": (1.0, 1.0, 0.0)}, "moment_rates_Nm_s: expected numbers > 0, got [1.0, 1.0, 0.0]"),
    (Limits, {"thrust_rate_N_s": 0.0}, "thrust_rate_N_s: expected a number > 0, got 0.0"),
    (Limits, {"thrust_rate_N_s": -3.0}, "thrust_rate_N_s: expected a number > 0, got -3.0"),
    (ControllerSettings, {"horizon": 0}, "horizon: expected an integer >= 1, got 0"),
    (ControllerSettings, {"horizon": -2}, "horizon: expected an integer >= 1, got -2"),
    (ControllerSettings, {"sampling_period_s": 0.0}, "sampling_period_s: expected a number > 0, got 0.0"),
    (ControllerSettings, {"sampling_period_s": -0.05}, "sampling_period_s: expected a number > 0, got -0.05"),
    (ControllerSettings, {"sampling_period_s": nan}, "sampling_period_s: expected a number > 0, got nan"),
    (ControllerSettings, {"relaxation": 0.0}, "relaxation: expected a number in (0, 1], got 0.0"),
    (ControllerSettings, {"relaxation": 1.01}, "relaxation: expected a number in (0, 1], got 1.01"),
    (ControllerSettings, {"relaxation": nan}, "relaxation: expected a number in (0, 1], got nan"),
]


@pytest.mark.parametrize(("make", "fields", "text"), BAD, ids=[f"{make.__name__} {f}" for make, f, _ in BAD])
def test_bad_setting_is_refused(make: Make, fields: dict[str, Any], text: str) -> None:
    """A setting out of its range never becomes a controller; one line names it, the expected and the given value."""
    with pytest.raises(SettingsError) as refused:
        make(**fields)
    assert str(refused.value) == text


# A nan compares as neither too small nor too large, so a check has to ask for what is right, not for what is wrong.
NOT_A_NUMBER: list[dict[str, Any]] = [
    {"moments_Nm": (nan, 1.0, 1.0)},
    {"moments_Nm": (1.0, 1.0, nan)},
    {"moment_rates_Nm_s": (1.0, nan, 1.0)},
    {"thrust_rate_N_s": nan},
]


@pytest.mark.parametrize("fields", NOT_A_NUMBER, ids=str)
def test_nan_is_refused(fields: dict[str, Any]) -> None:
    """A limit that is no number is refused with the same text as any other limit that is not > 0."""
    with pytest.raises(SettingsError, match=rf"^{next(iter(fields))}: expected .* > 0, got .*nan"):
        Limits(**fields)


def test_extremes_are_accepted() -> None:
    """The ends of the ranges belong to them: horizon 1, relaxation 1, thrust from zero."""
    assert ControllerSettings(horizon=1, relaxation=1.0).horizon == 1
    assert ControllerSettings(relaxation=1e-9, sampling_period_s=1e-6).relaxation == 1e-9
    assert Limits(thrust_N=(0.0, 1e-3)).lower(1)[0] == 0.0


def test_order_of_the_output_weights() -> None:
    """Q follows y of (14): UAV positions, payload attitude, yaw rates, payload position and velocity."""
    Q = Weights(position=1.0, attitude=2.0, yaw_rate=3.0, payload_position=4.0, payload_velocity=5.0).Q(2)
    assert Q.tolist() == [1.0] * 6 + [2.0] * 3 + [3.0] * 2 + [4.0] * 3 + [5.0] * 3


def test_the_paper_has_no_weight_on_the_payloads_way() -> None:
    """By default payload position and velocity have no weight, as the paper's outputs hold neither (section V-A)."""
    assert not Weights().Q(3)[-6:].any()


def test_order_of_the_input_weights() -> None:
    """R follows u = [thrust and three moments of each UAV]."""
    assert Weights(thrust=1.0, moments=(2.0, 3.0, 4.0)).R(3).tolist() == [1.0, 2.0, 3.0, 4.0] * 3


def test_limits_per_uav() -> None:
    """Bounds and rates repeat per UAV in the order of u; moments are bounded either way, rates per period."""
    limits = Limits(
        thrust_N=(2.0, 30.0), moments_Nm=(1.0, 2.0, 3.0), thrust_rate_N_s=80.0, moment_rates_Nm_s=(4.0, 8.0, 16.0)
    )
    assert limits.lower(2).tolist() == [2.0, -1.0, -2.0, -3.0] * 2
    assert limits.upper(2).tolist() == [30.0, 1.0, 2.0, 3.0] * 2
    assert limits.step(2, 0.25).tolist() == [20.0, 1.0, 2.0, 4.0] * 2


def test_settings_are_frozen() -> None:
    """Settings are data that several processes must agree on: they are immutable."""
    with pytest.raises(AttributeError):
        ControllerSettings().horizon = 3  # type: ignore[misc]  # the point of the test
    assert not np.shares_memory(Weights().Q(4), Weights().Q(4))
