"""Received power: path loss, reciprocity, shadowing, noise."""

import math

import numpy as np
import pytest

from transport.protocol.radio.propagation import Propagation, milliwatts, noise_mw

ROUNDING = 1e-12
STATIONS = 60
SIGMAS = 5.0


def test_power_falls_with_the_exponent_of_distance() -> None:
    """Ten times the distance loses ten times the exponent, in dB."""
    propagation = Propagation(power_mw=40.0, exponent=3.0, reference_loss_db=46.0)
    reference = propagation.at_reference(2)
    near = propagation.powers(reference, [(0.0, 0.0, 0.0), (0.0, 0.0, 4.0)])
    far = propagation.powers(reference, [(0.0, 0.0, 0.0), (0.0, 40.0, 0.0)])
    assert near[0][1] == pytest.approx(
        40.0 * milliwatts(-46.0 - 30.0 * math.log10(4.0)), rel=ROUNDING
    )
    assert 10.0 * math.log10(near[0][1] / far[0][1]) == pytest.approx(30.0, rel=ROUNDING)


def test_power_is_limited_near_the_sender() -> None:
    """Stations nearer than the reference distance receive the power of that distance."""
    propagation = Propagation(power_mw=40.0)
    reference = propagation.at_reference(2)
    touching = propagation.powers(reference, [(0.0, 0.0, 0.0), (0.0, 0.0, 0.0)])
    assert touching[0][1] == reference[0][1]


def test_shadowing_is_normal_reciprocal_and_constant() -> None:
    """The shadowing of a pair is the same in both directions, and normal over pairs."""
    propagation = Propagation(power_mw=40.0, shadowing_db=6.0, seed=3)
    shadowing = np.array(
        [[propagation.shadowing(i, j) for j in range(STATIONS)] for i in range(STATIONS)]
    )
    assert np.array_equal(shadowing, shadowing.T)
    values = shadowing[np.triu_indices(STATIONS, 1)]
    count = len(values)
    assert abs(values.mean()) < SIGMAS * 6.0 / math.sqrt(count)
    assert abs(values.std() - 6.0) < SIGMAS * 6.0 / math.sqrt(2.0 * count)
    assert propagation.shadowing(2, 7) == Propagation(
        power_mw=1.0, shadowing_db=6.0, seed=3
    ).shadowing(7, 2)


def test_thermal_noise() -> None:
    """20 MHz at 290 K have -101 dBm of noise, and a receiver adds its noise figure."""
    assert 10.0 * math.log10(noise_mw(20e6, 0.0)) == pytest.approx(-100.965, abs=1e-3)
    assert noise_mw(20e6, 7.0) == pytest.approx(noise_mw(20e6, 0.0) * 10.0**0.7, rel=ROUNDING)
