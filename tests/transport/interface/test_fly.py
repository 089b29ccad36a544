"""`transport.fly`: the runs of the command line as objects, in any thread, interrupted or not."""

import gc
import io
import os
import signal
import sys
import threading
import weakref
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
import threadpoolctl

import transport
from tests.support.logs import log_of
from tests.support.runs import recorded, reproducible
from transport.interface.fly import console
from transport.interface.run_series import QUANTITIES
from transport.interface.scenario_builder import path_phase
from transport.interface.setting_arguments import ArgumentError
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Message, Plan, PlantState
from transport.report.figures.style import RC, save

# A maneuver of 30 ticks.
PHASES = (
    {"name": "hover", "duration_s": 0.5, "displacement_m": [0.0, 0.0, 0.0]},
    {"name": "climb", "duration_s": 1.0, "displacement_m": [0.0, 0.0, -0.5]},
)
SHORT = (
    "maneuver.phase=["
    + ",".join(
        f"{{name='{phase['name']}',duration_s={phase['duration_s']},displacement_m={phase['displacement_m']}}}"
        for phase in PHASES
    )
    + "]"
)


def short(
    name: str = "resilient", settings: dict[str, Any] | None = None, **arguments: Any
) -> transport.Run:
    """Return a short run."""
    return transport.fly(name, settings, phases=PHASES, progress=False, **arguments)


@pytest.fixture(scope="module")
def run() -> transport.Run:
    """Return a short run with delay and packet loss."""
    return short("resilient", {"links.delay_s": 0.1, "links.loss": 0.2}, horizon=10)


def test_it_is_the_run_of_the_command_line(run: transport.Run) -> None:
    """Messages equal those of the same scenario with the same `--set`, bit for bit."""
    settings = ["links.delay_s=0.1", "links.loss=0.2", "controller.horizon=10", SHORT]
    path = find_scenario("resilient")
    expected = recorded(Setup.of(read_scenario(path, settings), str(path)))
    assert [str(reproducible(entry.message)) for entry in run.log.messages] == [
        str(reproducible(message)) for message in expected
    ]
    assert run.summary["startup_s"] > 0.0  # from the call to the first tick
    states = [entry.message for entry in run.log.messages if isinstance(entry.message, PlantState)]
    assert [state.x.tobytes() for state in states] == [
        m.x.tobytes() for m in expected if isinstance(m, PlantState)
    ]


@pytest.mark.slow
def test_a_saved_run_is_the_same_run(run: transport.Run, tmp_path: Path) -> None:
    """A run folder holds what the run held.

    Messages, series, summary; figures are files with the same pixels.
    """
    folder = run.save(tmp_path / "run")
    loaded = transport.load(folder)
    assert loaded.summary == run.summary
    assert loaded.scenario.digest() == run.scenario.digest()
    assert [e.message.kind for e in loaded.log.messages] == [
        e.message.kind for e in run.log.messages
    ]
    for name in QUANTITIES:
        np.testing.assert_array_equal(loaded.series[name], run.series[name])
    for name in ("performance", "trajectories", "timing"):
        figure = run.plot(name)  # type: ignore[arg-type]
        with mpl.rc_context(RC):
            save(figure, tmp_path / "own.png")
        assert (tmp_path / "own.png").read_bytes() == (
            folder / "figures" / f"{name}.png"
        ).read_bytes(), name
    with pytest.raises(FileExistsError):
        run.save(folder)
    copied = loaded.save(tmp_path / "copy")
    assert transport.load(copied).summary == run.summary


def test_series_have_names_units_and_shapes(run: transport.Run) -> None:
    """Every series has a row per tick, the axes it names, the unit in its name, and cannot be written to."""
    sizes = {"uav": 4, "agent": 4}
    for name, quantity in QUANTITIES.items():
        values = run.series[name]
        expected = [sizes[axis] if isinstance(axis, str) else len(axis) for axis in quantity.axes]
        assert values.shape == (30, *expected), name
        ending = quantity.unit.replace("/s", "ps").replace(" ", "")
        assert name.endswith(f"_{ending}") or not quantity.unit, name
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 0.0
    assert set(run.series) == set(QUANTITIES)
    with pytest.raises(transport.ArgumentError, match="expected one of time_s"):
        run.series.unit("speed")


def test_series_agree_with_each_other(run: transport.Run) -> None:
    """Errors are positions minus references.

    Summary numbers are those of the series; delays show in the plan ages.
    """
    series = run.series
    np.testing.assert_allclose(
        series["payload_position_m"] - series["payload_reference_m"],
        series["payload_error_m"],
        atol=1e-15,
    )
    assert run.summary["cost"]["mean"] == pytest.approx(series["cost"].mean(), rel=1e-12)
    assert run.summary["separation_min_m"] == series["separation_m"].min()
    ages = series["plan_age_ticks"]
    assert np.nanmin(ages) >= 2.0  # 100 ms are two periods
    assert np.nanmax(ages) == run.summary["plan_age_ticks"]["max"]
    assert np.nansum(series["plans_lost"]) == run.summary["messages"]["lost"] > 0
    assert np.isnan(ages[0]).all()  # nothing has arrived at the first tick


def test_tables(run: transport.Run) -> None:
    """Tables for pandas have the series as columns, or a row per agent and tick."""
    table = run.to_pandas()
    assert table.index.name == "time_s"
    np.testing.assert_array_equal(table["payload_error_m[z]"], run.series["payload_error_m"][:, 2])
    np.testing.assert_array_equal(table["uav_error_m[3,y]"], run.series["uav_error_m"][:, 2, 1])
    assert len(run.to_pandas("steps")) == 30 * 4


def test_a_run_is_shown_by_notebooks(run: transport.Run) -> None:
    """A figure has a picture for notebooks.

    `print(run)` is the table of `transport run`, its representation a line.
    """
    figure = run.plot()
    assert figure._repr_png_().startswith(b"\x89PNG")
    with pytest.raises(
        transport.ArgumentError, match="expected one of performance, inputs, trajectories, timing"
    ):
        run.plot("cost")  # type: ignore[arg-type]
    assert str(run).splitlines()[0] == "resilient completed"
    assert "payload attitude" in str(run)
    assert repr(run).startswith("Run('resilient': completed, 1.50 s, mean cost ")


@pytest.mark.parametrize(
    ("cost", "attitude_deg", "parts"),
    [
        (None, None, ""),
        (0.0, 0.0, ", mean cost 0, payload attitude max 0.00 deg"),
        (0.01234, 3.456, ", mean cost 0.0123, payload attitude max 3.46 deg"),
    ],
)
def test_a_run_is_represented_by_the_numbers_that_it_has(
    run: transport.Run, cost: float | None, attitude_deg: float | None, parts: str
) -> None:
    """A run that ended before its first tick has neither cost nor attitude; at rest they are zero."""
    found = transport.Run(run.scenario, run._setup, run.log)
    changed = {"cost": {"mean": cost}, "attitude_max_deg": attitude_deg}
    found.__dict__["summary"] = {**run.summary, **changed}
    assert repr(found) == f"Run('resilient': completed, 1.50 s{parts})"


def test_a_saved_run_is_copied_with_its_folder(run: transport.Run, tmp_path: Path) -> None:
    """With files that the user has put there."""
    found = transport.Run(run.scenario, run._setup, run.log)
    first = found.save(tmp_path / "first", figures=False)
    assert found.folder == first
    (first / "notes.txt").touch()
    second = found.save(tmp_path / "second", figures=False)
    files = [sorted(path.name for path in folder.iterdir()) for folder in (first, second)]
    assert files[0] == files[1]
    assert {"notes.txt", "run.mcap", "summary.json"} <= {*files[0]}


def test_a_run_that_diverges_is_a_run() -> None:
    """Divergence is a result, not an error."""
    found = short("paper", {"links.delay_s": 0.4, "plant.max_attitude_deg": 0.0001})
    assert (found.outcome, found.completed) == ("diverged", False)
    assert found.summary["reason"]


@pytest.mark.slow
def test_nothing_is_printed_to_standard_output(tmp_path: Path) -> None:
    """Standard output is the user's; progress goes to standard error, and can be silent."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        short(folder=tmp_path / "run")
    assert (out.getvalue(), err.getvalue()) == ("", "")
    assert (tmp_path / "run" / "summary.json").exists()


def test_real_time_needs_processes() -> None:
    """In memory no time passes: a scenario in real time is refused, not simulated as another."""
    with pytest.raises(
        transport.ScenarioError, match=r"clock.mode: expected lockstep in memory.*got realtime"
    ):
        short("paper", {"clock.mode": "realtime", "clock.speed": 1.0})


def test_a_recorded_run_may_be_large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It has been simulated, so that no limit refuses its scenario."""
    large = transport.Scenario("paper", {"plant.step_s": 1e-6}, allow_large=True)
    file = large.save(tmp_path / "scenario.toml")
    recorded_run = SimpleNamespace(scenario_file=file, setup=large.setup, log=log_of([]))
    monkeypatch.setattr("transport.interface.fly.open_run", lambda _: recorded_run)
    assert transport.load(tmp_path).scenario == large


def test_a_folder_that_exists_is_refused_before_the_simulation(tmp_path: Path) -> None:
    """Nothing is simulated in vain, and nothing written into a folder of the user."""
    with pytest.raises(ArgumentError, match="folder: expected a folder that does not exist yet"):
        transport.fly("paper", folder=tmp_path)
    assert not list(tmp_path.iterdir())


def digest(run: transport.Run) -> list[bytes]:
    """Return the bits of all plans and states."""
    messages: list[Message] = [entry.message for entry in run.log.messages]
    plans = [m.inputs.tobytes() for m in messages if isinstance(m, Plan)]
    return plans + [m.x.tobytes() for m in messages if isinstance(m, PlantState)]


def test_threads() -> None:
    """Runs in several threads at once, of one scenario object, have the same bits as one alone."""
    scenario = transport.Scenario("resilient", phases=PHASES)
    alone = digest(transport.fly(scenario, progress=False))
    before = threadpoolctl.threadpool_info()
    with ThreadPoolExecutor(3) as threads:
        found = threads.map(lambda _: digest(transport.fly(scenario, progress=False)), range(3))
    assert list(found) == [alone] * 3
    assert threadpoolctl.threadpool_info() == before
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_interrupt_ends_a_simulation() -> None:
    """Ctrl-C raises KeyboardInterrupt in the middle of a run.

    The next run has the same bits as ever.
    """
    expected, threads = digest(short()), threading.active_count()
    # Python loses an interrupt that comes while it collects objects of earlier tests: in a callback of
    # a weak reference. A run has no such callbacks.
    gc.collect()
    # Preparing a flight of 200 s takes a tenth of a second, in which libraries are opened; flying it
    # takes several.
    timer = threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        transport.fly("resilient", phases=[{**PHASES[0], "duration_s": 200.0}], progress=False)
    timer.join()
    assert digest(short()) == expected
    assert threading.active_count() == threads


def test_runs_leave_nothing_behind() -> None:
    """Runs that nothing refers to are freed: no cache keeps messages or setups."""
    references: list[Callable[[], object]] = []
    for _ in range(3):
        found = short("paper")
        references += [
            weakref.ref(found),
            weakref.ref(found.series),
            weakref.ref(found.scenario.setup),
        ]
        found.plot()
        del found
    gc.collect()
    assert [reference() for reference in references] == [None] * 9


def test_a_team_flies_a_path() -> None:
    """The team is that of `resized`.

    The payload's reference is the path, from its first row on, flat or not.
    """
    made = transport.team(3, vehicle="x500", load_kg=2, horizon=10)
    resized = transport.Scenario("resilient").resized(3, vehicle="x500", load_kg=2)
    assert made.digest() == resized.copy(horizon=10).digest()
    path = [[5.0, 1.0, 0.0, 0.0], [6.5, 1.15, 0.0, 0.0], [8.0, 1.3, 0.0, 0.0]]
    run = transport.fly(made, path=path, progress=False)
    assert run.completed
    np.testing.assert_allclose(
        run.series["payload_reference_m"][[0, 30], 0], [0.0, 0.15], atol=1e-9
    )
    # A spline speeds up and slows down in half of its time each, in 3 s at most.
    rows = [[0.0, 0.0, 0.0, 0.0], [10.0, 1.0, 0.0, 0.0]]
    ramps_s = [path_phase(given, flat=True)["ramp_s"] for given in (path, rows)]
    assert ramps_s == [1.5, 3.0]
    flat = transport.Scenario("eight", phases=[path_phase(path, flat=True)])
    along, _ = flat.setup.maneuver.path(np.array([0.0, 1.5, 3.0]))
    np.testing.assert_allclose(along[:, 0], [0.0, 0.15, 0.3], atol=1e-9)
    with pytest.raises(
        ArgumentError, match="path: expected two or more rows of t_s, x_m, y_m, z_m"
    ):
        transport.fly(made, path=[[0.0, 1.0, 2.0]])


def test_progress_in_a_notebook_is_lines_of_text(monkeypatch: pytest.MonkeyPatch) -> None:
    """A kernel that asks for colours is no terminal; hidden progress writes nothing."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.delitem(sys.modules, "ipykernel", raising=False)
    assert console(shown=True).is_terminal
    monkeypatch.setitem(sys.modules, "ipykernel", sys)
    notebook = console(shown=True)
    assert (notebook.stderr, notebook.quiet) == (True, False)
    assert not notebook.is_terminal
    assert not notebook.is_jupyter
    assert console(shown=False).quiet
