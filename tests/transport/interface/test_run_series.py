"""Series of a run by name: entries of hand-made messages, and NaN where there is none."""

import re
from collections.abc import Sequence

import numpy as np
import pytest
from msgspec.structs import replace

from tests.support import runs
from tests.support.log_messages import on_reference, report
from tests.support.logs import log_of
from transport.analysis.analysed_run import AnalysedRun
from transport.interface.run_series import QUANTITIES, RunSeries
from transport.model import state
from transport.model.arrays import Array
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import ActualInputs, Message

NAN = np.nan
PAIRS = "agents.owned=[[1,3],[2,4]]"
RELEASE = "faults.event=[{at_s=0.1,do='release',target='uav3'}]"


def series(run: Setup, messages: Sequence[Message]) -> RunSeries:
    """Return the series of a run from its messages."""
    return RunSeries(AnalysedRun.of(run, log_of(messages)))


def actual(run: Setup, k: int, tensions: Sequence[float] = ()) -> ActualInputs:
    """Return actual inputs of a tick, 100 k and above, all different."""
    N = run.system.N
    uavs = tuple(range(1, N + 1))
    return ActualInputs(
        sender="plant",
        incarnation=0,
        sequence=k,
        tick=k,
        uavs=uavs,
        inputs=100.0 * k + np.arange(4.0 * N).reshape(N, 4),
        cables=uavs if tensions else (),
        tensions=np.array(tensions),
    )


def test_places_and_attitudes_are_those_of_the_state_until_a_release() -> None:
    """In degrees and radians per second by body; a released UAV has a reference only."""
    run = runs.setup(runs.SHORT, RELEASE)

    def turned(x: Array, u: Array) -> None:
        x[state.THETA0] = np.radians([1.0, -2.0, 3.0])
        x[state.OMEGA0] = [0.1, 0.2, 0.3]
        x[state.R0] += [1.0, 2.0, 2.0]
        x[state.uav_slice(1)][state.THETA] = np.radians([4.0, 5.0, 6.0])

    found = series(run, [on_reference(run, 1), on_reference(run, 2, turned)])
    assert found["time_s"] == pytest.approx([0.05, 0.1])
    assert found["payload_attitude_deg"][1] == pytest.approx([1.0, -2.0, 3.0])
    assert found["attitude_max_deg"] == pytest.approx([0.0, 3.0])
    assert found["payload_rate_radps"][1] == pytest.approx([0.1, 0.2, 0.3])
    assert found["payload_position_m"][1] == pytest.approx([1.0, 2.0, -8.0])
    assert found["payload_reference_m"][1] == pytest.approx([0.0, 0.0, -10.0])
    assert found["payload_error_norm_m"] == pytest.approx([0.0, 3.0])
    assert found["uav_attitude_deg"][1, 1] == pytest.approx([4.0, 5.0, 6.0])
    for name in ("uav_position_m", "uav_attitude_deg", "uav_error_m"):
        is_missing = np.isnan(found[name]).all(axis=2)
        assert is_missing.tolist() == [[False] * 4, [False, False, True, False]], name
    assert np.isfinite(found["uav_reference_m"]).all()
    uav = run.system.uavs[0]
    places_m = uav.rho - np.array([0.0, 0.0, 10.0 + uav.rod_length])
    assert found["uav_position_m"][0, 0] == pytest.approx(places_m)


def test_inputs_have_their_limits_and_cables_their_tensions() -> None:
    """Moments are the commanded ones, rates and tensions missing, but for a recorded tick with cables."""
    run = runs.setup(runs.SHORT)

    def pushed(x: Array, u: Array) -> None:
        u[:] = np.arange(16.0)

    found = series(
        run,
        [
            *(on_reference(run, k, pushed) for k in range(2)),
            actual(run, 9, (1.0, 1.0, 1.0, 1.0)),  # no state of this tick is recorded
            actual(run, 1, (7.0, 5.0, 0.0, 6.0)),
        ],
    )
    assert found["thrust_N"][1].tolist() == [0.0, 4.0, 8.0, 12.0]
    assert found["moment_Nm"][1, 2].tolist() == [9.0, 10.0, 11.0]
    assert np.isnan(found["rate_command_radps"]).all()
    limits = run.settings.limits
    assert found["thrust_limits_N"].tolist() == [list(limits.thrust_N)] * 2
    assert found["moment_limit_Nm"].tolist() == [list(limits.moments_Nm)] * 2
    np.testing.assert_array_equal(found["cable_tension_N"], [[NAN] * 4, [7.0, 5.0, 0.0, 6.0]])


def test_commanded_rates_stand_beside_the_actual_moments() -> None:
    """Moments of a tick are the actual ones where they are recorded."""
    run = runs.ready("eight")
    N = run.system.N

    def commanded(x: Array, u: Array) -> None:
        u[:] = np.arange(4.0 * N)

    found = series(run, [*(on_reference(run, k, commanded) for k in range(2)), actual(run, 1)])
    assert found["rate_command_radps"][1, 2].tolist() == [9.0, 10.0, 11.0]
    assert np.isnan(found["moment_Nm"][0]).all()
    assert found["moment_Nm"][1, 2].tolist() == [109.0, 110.0, 111.0]
    assert np.isnan(found["cable_tension_N"]).all()


def test_agents_have_numbers_where_they_have_made_a_step() -> None:
    """Ages of the oldest plan, delays by receiver and sender, losses, times and forces; NaN without a step."""
    run = runs.setup(runs.SHORT, "links.delay_s=0.02")
    told = report(
        *(run, 2, 1), peers=(1, 3, 4), plan_ages=(1, 0, -1), lost=2, force=np.array([1.0, 2.0, 3.0])
    )
    unused = report(run, 3, 1, peers=(1, 2, 4), plan_ages=(-1, -1, -1))
    states = [on_reference(run, k) for k in range(2)]
    elsewhere = [
        report(run, 1, 9),
        replace(report(run, 1, 0), agent=5),
    ]  # of another tick, and team
    found = series(run, [*states, *elsewhere, told, unused])

    def row(of: Sequence[float]) -> Array:
        return np.array([[NAN] * 4, of])

    np.testing.assert_array_equal(found["plan_age_ticks"], row([NAN, 1.0, NAN, NAN]))
    np.testing.assert_array_equal(found["plans_lost"], row([NAN, 2.0, 0.0, NAN]))
    np.testing.assert_array_equal(found["step_ms"], row([NAN, 1.5, 1.5, NAN]))
    assert found["estimated_force_N"][1, 1].tolist() == [1.0, 2.0, 3.0]
    assert np.isnan(found["estimated_force_N"][1, 0]).all()
    delays_s = np.full((2, 4, 4), NAN)
    delays_s[1, 1, [0, 2]] = 0.02  # of agent 2, from agents 1 and 3
    np.testing.assert_allclose(found["plan_delay_s"], delays_s)


def test_the_error_of_an_agent_is_the_largest_of_its_uavs() -> None:
    """A released UAV does not count any more."""
    run = runs.setup(runs.SHORT, PAIRS, RELEASE)

    def leaning(x: Array, u: Array) -> None:
        x[state.uav_slice(2)][state.E] = [0.0, 0.6, 0.8]

    found = series(run, [on_reference(run, k, leaning) for k in (1, 2)])["uav_error_max_m"]
    assert found[0] == pytest.approx([3.2 * np.hypot(0.6, 0.2), 0.0], abs=1e-12)
    assert found[1] == pytest.approx([0.0, 0.0], abs=1e-12)


def test_a_name_has_columns_unit_axes_and_meaning() -> None:
    """UAVs and agents count from 1, in columns as in the listing of all series."""
    run = runs.setup(runs.SHORT)
    found = series(run, [on_reference(run, 0)])
    columns = found.columns()
    assert {name for name in columns if name.startswith(("cost", "uav_error_m[", "clear"))} == {
        *("cost", "clearance_m[UAVs]", "clearance_m[rods]", "clearance_m[payload]"),
        *(f"uav_error_m[{uav},{axis}]" for uav in (1, 2, 3, 4) for axis in "xyz"),
    }
    assert "plan_delay_s[1,4]" in columns
    assert (found.unit("cost"), found.unit("moment_Nm")) == ("", "N m")
    assert found.axes("plan_delay_s") == ("agent", "agent")
    assert found.meaning("separation_m") == "Smallest distance between two UAVs."
    first, *rest = repr(found).splitlines()
    assert first == "1 ticks; name, shape, meaning:"
    assert [re.split(r"\s+", line)[0] for line in rest] == list(QUANTITIES)
    assert len(found) == len(QUANTITIES)
