"""Benchmarks without processes: solutions of all solvers, and rows of hand-made measurements. No time is judged."""

import json
import sys
import zlib
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from benchmarks import __main__ as bench
from benchmarks import autopilots, estimates, solvers, step_and_tick_times, walls
from benchmarks.radio import plan_bytes
from benchmarks.runs import CLIMB, BenchmarkError, digits, programs, setup, spread
from docs.tables import put_rows
from tests.support import runs
from tests.support.logs import log_of
from tests.support.messages import sample
from transport.agent.estimation.filter.team_filter import TeamFilter
from transport.agent.node import AgentNode
from transport.model import state
from transport.model.arrays import Array
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.codec import encode
from transport.protocol.wire.messages import STAGES, Plan, VehicleStatus

# Largest differences from Clarabel's solutions, in units of half an actuator's range. The programs
# are flat in some directions: there Clarabel's gap of 1e-11 amounts to some 1e-6, and OSQP's 1e-8
# to a hundred times that.
EXACT, APPROXIMATE = 5e-5, 2e-3


@pytest.mark.slow
def test_solvers_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every installed solver solves programs with few and with many active limits."""
    missing = {"OSQP"} if find_spec("osqp") is None else set()
    monkeypatch.setattr(
        solvers, "SOLVERS", {n: solve for n, solve in solvers.SOLVERS.items() if n not in missing}
    )
    qps = [
        qp
        for settings in ((), solvers.TIGHT)
        for qp in programs(setup("paper", CLIMB, *settings), 4)
    ]
    for name, (ms, apart) in solvers.compare(qps, 1).items():
        assert apart < (APPROXIMATE if name == "OSQP" else EXACT), name
        assert min(ms) > 0.0


def test_three_digits_and_the_99th_percentile() -> None:
    """Numbers of any size have as many digits; a spread is median and 99th percentile."""
    assert [digits(value) for value in (0.012345, 1.0, 12.345, 1234.5)] == [
        "0.0123", "1.00", "12.3", "1230",
    ]  # fmt: skip
    assert spread([float(value) for value in range(101)]) == "50.0 (99.0)"


def test_cases_run_in_turns_until_each_has_its_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """A short case runs again while a long one waits; columns are the stages that are shown."""
    monkeypatch.setattr(step_and_tick_times, "STEPS", 5)
    begun = []

    def times_of(name: str, steps: int) -> Array:
        begun.append(name)
        return np.tile(np.arange(len(STAGES), dtype=np.float64), (steps, 1))

    found = step_and_tick_times.in_turns([("short", 2), ("long", 5)], times_of)
    assert begun == ["short", "long", "short", "short"]
    assert {case: len(ms) for case, ms in found.items()} == {("short", 2): 6, ("long", 5): 5}
    for ms in found.values():
        assert [STAGES[int(column)] for column in ms[0]] == list(step_and_tick_times.SHOWN)


def test_a_tick_is_the_wall_time_over_the_ticks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside it the spreads of steps and network, and the real-time factor."""
    times_ms = {"p50": 2.0, "p99": 3.0}
    summary = {
        "wall_time_s": 5.0, "real_time_factor": 8.0, "startup_s": 1.25,
        "agent_step_ms": times_ms, "rest_of_tick_ms": {"p50": 1.5, "p99": 2.5},
    }  # fmt: skip
    monkeypatch.setattr(
        step_and_tick_times, "setup", lambda *_, uavs: SimpleNamespace(ticks=50 * uavs)
    )
    monkeypatch.setattr(step_and_tick_times, "recorded", lambda _run: summary)
    rows = [line for line in step_and_tick_times.loop().splitlines() if line.startswith("| ")][1:]
    assert rows[0] == "| 4 | 25.0 | 2.00 (3.00) | 1.50 (2.50) | 8.00 | 1.25 |"
    assert rows[2].startswith("| 16 | 6.25 |")


def test_a_failed_measurement_leaves_the_page(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its reason is told; the sections before it are written."""
    page = tmp_path / "page.md"
    page.write_text(
        "".join(f"<!-- bench: {n} -->\nold\n<!-- end of bench: {n} -->\n" for n in ("one", "two"))
    )

    def fails() -> str:
        raise BenchmarkError("no run")

    monkeypatch.setattr(bench, "DOCUMENT", page)
    monkeypatch.setattr(bench, "SECTIONS", {"one": lambda: "new", "two": fails})
    monkeypatch.setattr(sys, "argv", ["benchmarks"])
    assert bench.main() == 1
    assert page.read_text().splitlines()[1] == "new"
    assert page.read_text().splitlines()[6] == "old"
    assert "benchmarks: no run" in capsys.readouterr().err


def test_rows_that_are_not_renewed_stay(tmp_path: Path) -> None:
    """In the order of all rows, whatever the order on the page; the source is the new one."""
    page = tmp_path / "page.md"
    page.write_text(
        "<!-- t -->\n| a | b |\n|---|---|\n| z | 1 |\n| x | 2 |\n\n*old.*\n<!-- end of t -->\n"
    )
    put_rows(page, "t", ("a", "b"), ("x", "y", "z"), {"y": ["3"], "x": ["4"]}, "new")
    assert page.read_text().splitlines()[3:-1] == [
        "| x | 4 |",
        "| y | 3 |",
        "| z | 1 |",
        "",
        "*new.*",
    ]


def vehicle_status(phase: str, latency_s: float, late_s: float) -> VehicleStatus:
    """Return the status of a vehicle with latency and jitter of its setpoints."""
    status: VehicleStatus = sample(VehicleStatus, phase=phase, latency_s=latency_s, late_s=late_s)
    return status


def test_latencies_above_autopilots_are_in_scenario_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of flying vehicles, those without a setpoint left out; the busiest process that ended counts."""
    summary = {
        "outcome": "completed", "payload_tracking": {"rms_m": 0.0712},
        "attitude_max_deg": 3.14, "separation_min_m": 0.567,
    }  # fmt: skip
    statuses = [
        vehicle_status("ready", 9.0, 9.0),
        vehicle_status("flying", 0.02, 0.004),
        vehicle_status("flying", -1.0, 0.006),
        vehicle_status("flying", 0.04, 0.008),
    ]

    def entry(event: str, time_s: float, cpu_s: float) -> str:
        return json.dumps({"event": event, "time": time_s, "cpu_s": cpu_s})

    def run(command: list[str], **_: object) -> None:
        assert command[3:5] == ["run", "flight"]
        assert {"plant.autopilot=stand_in", "clock.speed=0.5", "links.loss=0.3"} <= set(command)
        folder = Path(command[command.index("--out") + 1])
        (folder / "logs").mkdir(parents=True)
        (folder / "summary.json").write_text(json.dumps(summary))
        begin = [entry("listening", 1.0, 2.0), entry("joined", 10.0, 2.5)]
        for uav, end in (
            (1, [entry("finished", 20.0, 3.0)]),
            (2, [entry("finished", 30.0, 5.0)]),
            (3, []),
        ):
            (folder / "logs" / f"vehicle{uav}.log").write_text("\n".join([*begin, *end]))

    monkeypatch.setattr("benchmarks.autopilots.subprocess.run", run)
    monkeypatch.setattr(autopilots, "read_log", lambda _: log_of(statuses))
    assert autopilots.row("late", ("links.loss=0.3",), "stand_in", 0.5) == [
        "late", "completed", "7.1 cm", "3.1 deg", "0.57 m",
        "15.0 ms, 19.9 ms", "3.0 ms, 4.0 ms", "15.0 %",
    ]  # fmt: skip


def test_an_error_of_one_deviation_in_each_coordinate(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its squared error in units of the covariance is the number of coordinates, which is in the band."""
    run = runs.ready("precise", "plant.sensors=vehicle", "controller.estimator=kalman")
    belief = TeamFilter(run.run).first(run.hover.x)
    deviations = np.sqrt(belief.covariance.P.diagonal())
    direction = belief.covariance.basis.T @ deviations

    def simulated(x: Array) -> Callable[[Any], Any]:
        return lambda _setup: (True, {0: x}, [(0, belief), (1, belief)])

    # 95 % of the squared errors of 52 coordinates are from 34 to 73.8.
    for squared, is_in_band in [(0.6, False), (0.7, True), (1.0, True), (1.4, True), (1.45, False)]:
        scale = np.sqrt(squared)
        monkeypatch.setattr(estimates, "simulated", simulated(belief.x + scale * direction))
        found = estimates.compared(run)
        assert found.nees == pytest.approx(52.0 * squared)
        assert (found.is_completed, found.is_in_band) == (True, is_in_band)
        error_cm = 100.0 * scale * np.linalg.norm(deviations[:3])
        assert found.estimate_error_cm == pytest.approx(error_cm)

    monkeypatch.setattr(estimates, "simulated", simulated(belief.x))
    found = estimates.compared(run)
    assert (found.nees, found.is_in_band) == (0.0, False)
    place, _ = run.maneuver.path(np.zeros(1))
    off_m = np.linalg.norm(belief.x[state.R0] - place[0])
    assert found.payload_error_cm == pytest.approx(100.0 * off_m, abs=1e-9)


def test_a_row_has_the_ranges_of_its_seeds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside them the error of the same flight with measured states, which has no noise."""
    found = iter(
        estimates.Comparison(
            is_completed=seed != 1, payload_error_cm=2.0 - seed, largest_attitude_deg=3.0,
            estimate_error_cm=seed, nees=52.0, is_in_band=seed == 2,
        )
        for seed in range(3)
    )  # fmt: skip
    seeds: list[int] = []
    flown: list[Any] = []

    def compared(setup: Setup) -> estimates.Comparison:
        assert setup.scenario.plant.sensors == "vehicle"
        seeds.append(setup.scenario.seed)
        return next(found)

    def fly(scenario: Any, *, progress: bool) -> Any:
        flown.append(scenario.setup.scenario)
        return SimpleNamespace(summary={"payload_tracking": {"rms_m": 0.0123}})

    monkeypatch.setattr(estimates, "compared", compared)
    monkeypatch.setattr("transport.fly", fly)
    changes = {"links.delay_s": 0.2, "plant.noise.delay.position_s": 0.1}
    assert estimates.row("a case", changes, 3) == [
        "a case", "2 of 3", "0.00 - 2.00", "3.00 - 3.00", "0.00 - 2.00", "52.00 - 52.00", "1 of 3", "1.23",
    ]  # fmt: skip
    assert seeds == [0, 1, 2]
    (measured,) = flown
    assert (measured.links.delay_s, measured.plant.sensors) == (0.2, "state")
    assert measured.plant.noise == type(measured.plant.noise)()


def test_a_step_with_the_filter_over_one_without(monkeypatch: pytest.MonkeyPatch) -> None:
    """The median of the ratios of all turns."""
    times_ms = iter([1.0, 2.0, 1.0, 8.0, 2.0, 6.0])
    monkeypatch.setattr(estimates, "_step_ms", lambda _setup: next(times_ms))
    monkeypatch.setattr(estimates, "compile_functions", lambda _uavs: None)
    assert estimates.step_ratio(4) == 3.0


@pytest.mark.parametrize(
    ("off_m", "speed_mps", "outcome", "ends"),
    [
        (0.0, 0.0, "completed", (True, False)),
        (0.29, 0.0, "completed", (True, False)),
        (0.31, 0.04, "completed", (False, True)),
        (0.31, 0.06, "completed", (False, False)),
        (0.5, 0.0, "diverged", (False, False)),
        (0.0, 0.0, "diverged", (False, False)),
    ],
)
def test_a_run_goes_round_a_wall_or_rests_before_it(
    off_m: float,
    speed_mps: float,
    outcome: str,
    ends: tuple[bool, bool],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It arrives at the end of its path, or stands still elsewhere; distances are those of the bodies named."""
    run = runs.setup("obstacle=[{kind='sphere',at_m=[0,0,50],radius_m=1.0,margin_m=0.4}]")
    goal_I = run.maneuver.path(np.array([run.maneuver.duration_s]))[0][0]
    x = run.hover.x.copy()
    x[state.R0] = goal_I - [off_m, 0.0, 0.0]
    x[state.V0] = [speed_mps, 0.0, 0.0]
    x[state.THETA0] = [0.0, -0.1, 0.05]

    def simulate(_setup: Any, record: Callable[[Any], None]) -> Any:
        record(structs.replace(runs.plant_state(run, 0), x=x))
        return SimpleNamespace(outcome=outcome)

    monkeypatch.setattr(walls, "setup_of", lambda _row, _seed: run)
    monkeypatch.setattr(walls, "simulate", simulate)
    found = walls.fly("perfect network", 100)
    assert (found.arrives, found.rests) == ends
    assert found.attitude_deg == pytest.approx(np.degrees(0.1))
    uavs_I = run.model.outputs_along(x[None])[0, : 3 * run.system.N].reshape(-1, 3)
    away_m = np.linalg.norm(uavs_I - [0.0, 0.0, 50.0], axis=1).min() - 1.0
    assert found.uav_m == pytest.approx(away_m)
    assert found.load_m < found.uav_m - 2.0  # the payload is below the UAVs


def test_lengths_of_plans_in_shorter_forms() -> None:
    """As their bytes are, where the form can be sent; float32 has half the bytes of each number."""
    run = runs.setup()
    inputs = 0.1 * np.arange(80.0).reshape(20, 4)
    plan = structs.replace(
        runs.plan(run, 2, 3, x=run.initial_state() + 0.1), inputs=inputs, corrections=0.1 * inputs
    )
    numbers = plan.uav_states.size + inputs.size + inputs.size
    assert plan_bytes.length(plan, plan_bytes.single) == len(encode(plan)) - 4 * numbers
    first = structs.replace(plan, inputs=inputs[:1])
    assert plan_bytes.length(plan, plan_bytes.first_input) == len(encode(first))
    both = len(encode(first)) - 4 * (numbers - inputs[1:].size)
    assert plan_bytes.length(plan, plan_bytes._both) == both
    bare = structs.replace(plan, corrections=inputs[:0])
    assert plan_bytes.length(plan, plan_bytes.without_corrections) == len(encode(bare))

    held, short = np.tile(inputs[0], (20, 1)), np.float32
    for form, expected in (
        (plan_bytes.first_input, (plan.uav_states, held, plan.corrections)),
        (plan_bytes.single, map(short, (plan.uav_states, inputs, plan.corrections))),
        (plan_bytes._both, map(short, (plan.uav_states, held, plan.corrections))),
        (plan_bytes.without_corrections, (plan.uav_states, inputs, 0.0 * inputs)),
    ):
        taken = form(plan)
        for got, wanted in zip(
            (taken.uav_states, taken.inputs, taken.corrections), expected, strict=True
        ):
            np.testing.assert_array_equal(got, wanted)


def numbers_of(data: bytes) -> Array:
    """Return the numbers of a plan that is compressed: their first bytes, their second ones and so on."""
    by_byte = np.frombuffer(zlib.decompress(data), np.uint8).reshape(8, -1)
    return np.frombuffer(by_byte.T.tobytes(), np.float64)


def test_compressed_plans_are_numbers_or_differences_from_the_last_one() -> None:
    """No bit differs from one with the same states, and inputs and corrections of a step later."""
    run = runs.setup()
    inputs = np.random.default_rng(1).uniform(0.0, 9.0, (20, 4))
    before: Plan = structs.replace(runs.plan(run, 2, 3), inputs=inputs, corrections=2.0 * inputs)
    parts = (before.uav_states, inputs, 2.0 * inputs)
    whole = np.concatenate([part.ravel() for part in parts])
    (compressed,) = plan_bytes.compressed([before])
    np.testing.assert_array_equal(numbers_of(compressed), whole)

    shifted = np.vstack([inputs[1:], inputs[-1:]])
    ended = np.vstack([2.0 * inputs[1:], np.zeros((1, 4))])
    after = structs.replace(before, inputs=shifted, corrections=ended)
    (difference,) = plan_bytes.differences([before, after])
    assert not numbers_of(difference).view(np.uint64).any()
    assert len(difference) < len(compressed)


def test_agents_take_a_form_of_the_plans(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of others; messages of the run are as they were sent."""
    run = runs.setup()
    plan = runs.plan(run, 2, 3)
    taken: list[Any] = []

    def simulate(_setup: Any, record: Callable[[Any], None]) -> None:
        AgentNode._take_plan("node", plan, 7)  # type: ignore[arg-type]
        record(plan)

    monkeypatch.setattr(AgentNode, "_take_plan", lambda *given: taken.append(given))
    monkeypatch.setattr(plan_bytes, "simulate", simulate)
    short = structs.replace(plan, inputs=plan.inputs[:1])
    assert plan_bytes.flown(run, lambda _: short) == [plan]
    assert taken == [("node", short, 7)]


def test_each_form_has_a_row_with_its_effect(monkeypatch: pytest.MonkeyPatch) -> None:
    """In every network of the headings: equal bits, or how far the payload is from the run with whole plans."""
    run = runs.setup()
    one, other = (
        structs.replace(runs.plan(run, agent, 3), inputs=np.ones((20 * agent, 4)))
        for agent in (1, 2)
    )
    states = [runs.plant_state(run, tick) for tick in (0, 1)]
    asked: list[Setup] = []

    def flown(setup: Setup, form: plan_bytes.Form) -> list[Any]:
        asked.append(setup)
        x = states[1].x.copy()
        network = (len(asked) - 1) % 3
        if form is not plan_bytes._whole and network > 0:
            x[20] += 5.0  # of a UAV
            x[1] -= 0.002 * (network - 1)
        # The bytes are those in the perfect network.
        sent = other if network == 0 else structs.replace(other, corrections=other.inputs)
        return [one, sent, sent, states[0], structs.replace(states[1], x=x)]

    written: list[Any] = []
    monkeypatch.setattr(plan_bytes, "flown", flown)
    monkeypatch.setattr(plan_bytes, "put", lambda *given: written.append(given))
    monkeypatch.setattr(plan_bytes, "origin", lambda: "today")
    plan_bytes.main()

    perfect, late, death = (setup.scenario for setup in asked[:3])
    assert (perfect.links.delay_s, late.links.delay_s, late.links.loss) == (0.0, 0.1, 0.3)
    assert [(event.do, event.target) for event in death.faults.event] == [("kill", "agent2")]
    ((page, marker, text),) = written
    assert (page.name, marker) == ("radio.md", "bytes")
    assert text.partition("\n\n")[0].endswith(" today.")
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| ")][
        1:
    ]
    effects = ["equal bits", "0 mm", "2 mm"]
    short = [
        plan_bytes.length(other, form)
        for form in (plan_bytes.first_input, plan_bytes.single, plan_bytes._both)
    ]
    bits = ["equal bits"] * 3
    (whole,) = {len(data) for data in map(encode, (other, other))}
    packed, changed = plan_bytes.compressed([other]), plan_bytes.differences([other, other])
    assert [row[1:] for row in rows] == [
        [f"{whole}", *bits],
        [f"{len(packed[0])}", *bits],
        [f"{len(changed[0])}", "equal bits", "useless without the last plan", "equal bits"],
        *[[f"{length}", *effects] for length in short],
        [f"{plan_bytes.length(other, plan_bytes.without_corrections)}", *effects],
    ]
    assert len(changed[0]) < len(packed[0])
