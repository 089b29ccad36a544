"""Payload swing at the end of a run: synthetic pendulums of known damping, and the paper's maneuver."""

import math
from collections.abc import Iterable

import pytest

from model import state
from model.arrays import Array
from protocol.scenario.setup import Setup
from protocol.wire.messages import PlantState
from tests.support import runs
from tests.support.logs import log_of, plant_state
from transport.analysis.metrics import summarise
from transport.analysis.series import AT_REST_M, Swing, series_of, swing_of

# The last hover of the paper's maneuver, after a second of translation.
HOLD = (
    "maneuver.phase=[{name='translate',duration_s=1.0,displacement_m=[0.5,0,0]},"
    "{name='hover',duration_s=5.0,displacement_m=[0,0,0]}]"
)
TICKS = 120
OMEGA = math.sqrt(9.81 / 3.2)  # pendulum of the paper's rods, rad/s

# Phases at t = 0 that cover the half period in which the speed repeats.
PHASES = [math.pi * i / 8.0 for i in range(8)]

# The largest error between two samples 50 ms apart: 1 - cos(OMEGA 0.025) = 1e-3, and the damping in between.
SAMPLING = 5e-3


def swinging(
    run: Setup,
    *,
    amplitude_m: float = 0.3,
    damping: float = 0.0,
    phase: float = 0.0,
    omega: float = OMEGA,
    offset_I: tuple[float, float, float] = (0.0, 0.0, 0.0),
    vertical_mps: float = 0.0,
    ticks: Iterable[int] = range(TICKS),
) -> Swing:
    """Measure a pendulum in y, amplitude_m exp(-damping t) cos(omega t + phase), about an offset of the payload.

    Args:
        run: Its payload carries the swing on top of the reference.
        amplitude_m: At t = 0.
        damping: 1/s; negative for a growing swing.
        phase: At t = 0, rad.
        omega: rad/s.
        offset_I: Constant position error, (3,), m.
        vertical_mps: Vertical speed at t = 0, that decays with 1/s.
        ticks: Those in the log.
    """

    def at(k: int) -> PlantState:
        t_s = 0.05 * k
        envelope_m = amplitude_m * math.exp(-damping * t_s)
        cos, sin = math.cos(omega * t_s + phase), math.sin(omega * t_s + phase)

        def change(x: Array, u: Array) -> None:
            x[state.R0] += offset_I
            x[1] += envelope_m * cos
            x[state.V0] = [0.0, -envelope_m * (damping * cos + omega * sin), vertical_mps * math.exp(-t_s)]

        return plant_state(run, k, change)

    return swing_of(run, series_of(run, log_of([at(k) for k in ticks])))


@pytest.mark.parametrize("phase", PHASES)
def test_a_sustained_swing_does_not_decay(phase: float) -> None:
    """A constant or growing amplitude never counts as decaying, whatever the phase at the end of the run."""
    run = runs.setup(HOLD)
    swing = swinging(run, phase=phase)
    assert swing.decays is False
    assert swing.largest_m == pytest.approx(0.3, rel=SAMPLING)
    assert swinging(run, phase=phase, damping=-0.1).decays is False


@pytest.mark.parametrize("phase", PHASES)
def test_a_damped_swing_decays(phase: float) -> None:
    """A damping ratio of 0.02 counts as decaying at any phase; one of 0.003 does not."""
    run = runs.setup(HOLD)
    assert swinging(run, phase=phase, damping=0.02 * OMEGA).decays is True
    assert swinging(run, phase=phase, damping=0.003 * OMEGA).decays is False


def test_a_constant_offset_is_no_swing() -> None:
    """Rods that lean in wind add to the error; whether the swing about it decays does not depend on that."""
    run, lean = runs.setup(HOLD), (0.0, 0.22, 0.0)
    still = swinging(run, amplitude_m=0.0, offset_I=lean)
    assert still.decays is True
    assert still.largest_m == pytest.approx(0.22, rel=1e-12)
    for phase in PHASES:
        assert swinging(run, phase=phase, offset_I=lean).decays is False
        assert swinging(run, phase=phase, offset_I=lean, damping=0.02 * OMEGA).decays is True


def test_vertical_motion_is_no_swing() -> None:
    """A vertical error that vanishes does not make a sustained swing decay."""
    assert swinging(runs.setup(HOLD), amplitude_m=0.05, vertical_mps=5.0).decays is False


def test_a_small_swing_is_at_rest() -> None:
    """Below 1 cm a swing counts as at rest even if it is sustained."""
    run = runs.setup(HOLD)
    assert swinging(run, amplitude_m=0.9 * AT_REST_M).decays is True
    assert swinging(run, amplitude_m=1.1 * AT_REST_M).decays is False


def test_runs_that_do_not_tell() -> None:
    """Without 4 s of hold at the end, or with a gap in them, `decays` is None; the error is measured all the same."""
    run = runs.setup(HOLD)
    short = runs.setup(HOLD.replace("duration_s=5.0", "duration_s=3.95"))
    moving = runs.setup(HOLD.replace("[0,0,0]", "[0,0,0.1]"))
    assert swinging(short, ticks=range(99)).decays is None
    assert swinging(moving).decays is None
    assert swinging(run, ticks=range(99)).decays is None  # ended 3.95 s into the hold
    assert swinging(run, ticks=range(100)).decays is False
    gap = swinging(run, ticks=[*range(100), *range(101, TICKS)])
    assert gap.decays is None
    assert gap.largest_m == pytest.approx(0.3, rel=SAMPLING)
    assert swinging(run, ticks=[]) == Swing(largest_m=None, decays=None)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "decays"), [("centralized", False), ("centralized_lq", True)])
def test_the_papers_maneuver(name: str, decays: bool) -> None:
    """A horizon of 1 s leaves a sustained swing of 0.55 m; with the infinite horizon behind it the swing dies out."""
    run = runs.ready(name)
    messages = runs.recorded(run)
    payload = summarise(run, log_of(messages))["payload_tracking"]
    assert payload["decays"] is decays
    assert (payload["swing_m"] < 0.4) is decays
