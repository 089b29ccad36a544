"""`transport replay`: equal bits from equal messages, and the first difference otherwise."""

import json
from bdb import BdbQuit
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace as edited
from typer.testing import CliRunner, Result

from tests.support import logs, runs
from transport.analysis.replay.replay_difference import Comparison, Difference, InputsApart
from transport.analysis.replay.replay_of_agent import Replay, _due_changes, _follows
from transport.cli.commands import replay
from transport.cli.main import app
from transport.flight.run_files import machine, versions
from transport.log.run_log import RunLog
from transport.log.tables import INPUT_NAMES, RATE_NAMES
from transport.protocol.scenario.scenario_file import read_scenario
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.wire.messages import LinkChange, Measurement, Message, Plan

CLOSED_LOOP = ("controller.prediction='closed_loop'", "controller.relaxation='auto'")
POOR_LINKS = (
    "links.delay_s=0.06",
    "links.jitter_s=0.1",
    "links.loss=0.2",
    "links.duplicate=0.1",
    "links.reorder=0.1",
)
TROUBLE = (
    *("clock.on_agent_loss='continue'", "links.measurement.delay_s=0.1"),
    "faults.event=[{at_s=0.2,do='kill',target='agent3'},{at_s=0.5,do='restart',target='agent3'},"
    "{at_s=0.6,do='stop',target='agent2'},{at_s=0.9,do='continue',target='agent2'}]",
    "links.change=[{at_s=0.7,from='agent1',to='agent2',loss=0.9}]",
)
# Not recorded in real time: when an agent noticed a lost plan.
UNKNOWN_IN_REAL_TIME = ("report.lost",)


def flight(*settings: str) -> RunLog:
    """Return the log of a simulated run."""
    return logs.log_of(runs.recorded(runs.setup(runs.SHORT, *settings)))


def compared(
    log: RunLog, agent: int, *settings: str, ignored: Sequence[str] = ()
) -> tuple[Replay, Comparison]:
    """Return a complete replay and its comparison, with the settings of the run or others."""
    again, comparison = Replay(runs.setup(runs.SHORT, *settings), log, agent), Comparison()
    for step in again.steps():
        comparison.add(step, ignored=ignored)
    return again, comparison


def plans(log: RunLog, agent: int) -> list[Plan]:
    """Return the plans of an agent."""
    return [plan for plan in log.of(Plan) if plan.agent == agent]


@pytest.mark.parametrize(
    "settings",
    [
        (),
        (*CLOSED_LOOP, *POOR_LINKS, *TROUBLE),
        (*CLOSED_LOOP, "controller.negotiation_iterations=2", "links.loss=0.3"),
        (*CLOSED_LOOP, "controller.negotiation_iterations=2", "radio={offsets='none'}"),
        (*CLOSED_LOOP, *TROUBLE, "radio={offsets='none'}"),
    ],
    ids=[
        "as published",
        "poor links, killed, stopped",
        "negotiation_iterations",
        "radio, negotiation_iterations",
        "radio, killed, stopped",
    ],
)
def test_a_lockstep_run_is_reproduced(settings: tuple[str, ...]) -> None:
    """In lockstep an agent that gets the recorded messages sends the recorded plans and reports, bit for bit."""
    log = flight(*settings)
    for agent in runs.setup().agents:
        again, comparison = compared(log, agent, *settings)
        assert comparison.by_field == {}
        assert comparison.plans == comparison.identical == len(plans(log, agent))
        assert again.notes == []


def test_a_real_time_run_is_reproduced() -> None:
    """In real time the reports tell which plans an agent had, in whatever order they reached the recorder."""
    settings = (
        "clock.mode='realtime'",
        "clock.speed=1.0",
        "clock.actuation='next_tick'",
        "links.loss=0.2",
    )
    log = flight(*settings)
    # The recorder receives all plans of a tick before the other messages of the tick.
    ordered = sorted(
        log.messages, key=lambda entry: (entry.message.tick, not isinstance(entry.message, Plan))
    )
    for agent in (1, 3):
        log = replace(log, messages=tuple(ordered))
        _, comparison = compared(log, agent, *settings, ignored=UNKNOWN_IN_REAL_TIME)
        assert comparison.by_field == {}
        assert comparison.identical == len(plans(log, agent)) > 0


def test_one_bit_is_found() -> None:
    """A number that differs in its last bit is reported with tick, field, entry, both values and the size."""
    log = flight()
    victim = next(plan for plan in plans(log, 2) if plan.tick == 7)
    inputs = victim.inputs.copy()
    inputs[3, 0] = np.nextafter(inputs[3, 0], np.inf)
    changed = edited(victim, inputs=inputs)
    log = logs.log_of(
        [changed if entry.message is victim else entry.message for entry in log.messages]
    )
    _, comparison = compared(log, 2)
    first = comparison.first
    assert first is not None
    assert (first.tick, first.field) == (7, "plan.inputs")
    assert "UAV2 thrust_N, step 3" in first.where
    assert (float(first.expected), float(first.got)) == (inputs[3, 0], victim.inputs[3, 0])
    assert first.size == inputs[3, 0] - victim.inputs[3, 0] > 0.0
    assert comparison.plans - comparison.identical == 1


def test_a_missing_plan_ends_the_replay() -> None:
    """A missing plan that the agent waited for ends the replay with a note.

    Earlier ticks are compared.
    """
    log = flight()
    messages = [entry.message for entry in log.messages]
    lost = next(plan for plan in plans(log, 3) if plan.tick == 9)
    kept = [message for message in messages if message is not lost]
    again, comparison = compared(logs.log_of(kept), 1)
    assert comparison.ticks == list(range(10))
    assert comparison.by_field == {}
    assert len(again.notes) == 1
    assert "ticks from 10 on cannot be replayed" in again.notes[0]


def test_a_missing_measurement_ends_the_replay() -> None:
    """The step after the gap would start from another state: it is not replayed."""
    log = flight()
    kept = [
        entry.message
        for entry in log.messages
        if not (
            isinstance(entry.message, Measurement)
            and (entry.message.agent, entry.message.tick) == (1, 9)
        )
    ]
    again, comparison = compared(logs.log_of(kept), 1)
    assert comparison.ticks == list(range(9))
    assert comparison.by_field == {}
    (note,) = again.notes
    assert "ticks from 10 on cannot be replayed" in note


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder."""
    path = tmp_path_factory.mktemp("replay") / "run"
    logs.record_run(runs.setup(runs.SHORT), path)
    return path


def ask(*arguments: str | Path) -> Result:
    """Run the command in this process."""
    return CliRunner().invoke(app, ["replay", *map(str, arguments)])


def test_command_reports_identical_plans(folder: Path) -> None:
    """The replay of an unchanged run exits with 0 and reports identical plans."""
    result = ask(folder, "--agent", "2")
    assert result.exit_code == 0, result.output
    assert "all 30 plans of ticks 0 to 29 are identical, bit for bit" in result.output


def test_command_names_the_first_tick(folder: Path, tmp_path: Path) -> None:
    """With one weight changed it exits with 8 and gives the first tick, a figure, and the same as JSON."""
    what_if = (folder, "--agent", "2", "--set", "controller.weights.attitude=6.0")
    result = ask(*what_if, "--from", "3", "--out", tmp_path)
    assert result.exit_code == 8
    assert "agent2: 27 of 27 plans of ticks 3 to 29 are different from tick 3 on" in result.output
    assert {path.name for path in tmp_path.iterdir()} == {"replay.png", "replay.svg"}
    content = json.loads(ask(*what_if, "--format", "json").stdout)
    assert content["first"]["tick"] == 0
    assert content["first"]["kind"] == Plan.kind
    assert content["plans"] == 30
    assert content["first_tick_beyond_rounding"] == 0
    part = json.loads(ask(*what_if, "--from", "3", "--to", "6", "--format", "json").stdout)
    assert (part["ticks"], part["plans"], part["first"]["tick"]) == ([3, 6], 4, 3)


def test_a_field_is_told_by_its_largest_difference() -> None:
    """With the first tick and the number of ticks at which it differs."""
    sizes = ((4, 0.5), (4, 2.0), (6, 1.0), (7, None))
    same: dict[str, Any] = {
        "kind": "plan",
        "negotiation": 0,
        "name": "inputs",
        "where": "",
        "got": "",
        "expected": "",
    }
    differences = [Difference(tick=tick, size=size, **same) for tick, size in sizes]
    comparison: Any = SimpleNamespace(by_field={"plan.inputs": differences})
    (row,) = replay._fields(comparison)
    assert (row["field"], row["ticks"], row["first_tick"]) == ("plan.inputs", 3, 4)
    assert (row["largest"]["tick"], row["largest"]["size"]) == (4, 2.0)


def test_the_debugger_opens_before_one_tick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before the measurement of the asked tick alone; without one it stays closed."""
    opened: list[int] = []
    monkeypatch.setattr(replay, "leave_interrupts_to_python", lambda: None)
    node: Any = None
    for asked, expected in ((3, [3]), (None, [])):
        before = replay._debugger_at(asked)
        for tick in range(6):
            monkeypatch.setattr("sys.breakpointhook", lambda tick=tick: opened.append(tick))
            before(node, runs.measurement(runs.setup(), 1, tick))
        assert opened == expected
        opened.clear()


class Again:
    """A replay of the ticks 0 to 9, left in the debugger at one of them."""

    left_at: int | None = None
    notes: Sequence[str] = ()

    def __init__(self, setup: Any, _log: Any, _agent: int, before: Any = None) -> None:
        self.setup = setup
        self.before = before

    def steps(self) -> Iterator[Any]:
        """Yield its ticks."""
        for tick in range(10):
            if tick == self.left_at:
                raise BdbQuit
            yield SimpleNamespace(tick=tick)


@pytest.mark.parametrize(
    ("scenario", "settings", "ignored", "names"),
    [
        ("paper", (), (), INPUT_NAMES),
        ("resilient", ("controller.inputs=rates",), (), RATE_NAMES),
        ("paper", ("clock={mode='realtime',speed=1.0}",), UNKNOWN_IN_REAL_TIME, INPUT_NAMES),
    ],
)
def test_ticks_are_compared_by_clock_and_inputs(
    scenario: str,
    settings: tuple[str, ...],
    ignored: tuple[str, ...],
    names: tuple[str, ...],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In real time without what no log tells; the first and the last tick that are asked for count."""
    setup = runs.ready(scenario, *settings)
    added: list[Any] = []
    monkeypatch.setattr(
        Comparison, "add", lambda _, step, ignored: added.append((step.tick, ignored))
    )
    options = replay.ReplayOptions(begin=2, end=4, stop_at=7)
    run: Any = SimpleNamespace(setup=setup)
    again: Any = Again(setup, None, 1)
    assert replay._compared(run, again, options).command_names == names
    assert added == [(tick, ignored) for tick in (2, 3, 4)]


def test_a_debugger_that_is_left_ends_the_command(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before the end of the comparison; it has been asked for at its tick."""
    made: list[Again] = []

    class Left(Again):
        left_at = 5

        def __init__(self, *given: Any) -> None:
            super().__init__(*given)
            made.append(self)

    opened: list[int] = []
    monkeypatch.setattr(replay, "Replay", Left)
    monkeypatch.setattr(
        replay, "Comparison", lambda **_: SimpleNamespace(add=lambda *_, **__: None)
    )
    result = ask(folder, "--agent", "1", "--pdb", "5")
    assert result.exit_code == 2
    where = "--pdb: the debugger was left at tick 5, before the end of the comparison"
    assert result.stderr == f"transport: {where}\n"
    monkeypatch.setattr(replay, "leave_interrupts_to_python", lambda: opened.append(-1))
    monkeypatch.setattr("sys.breakpointhook", lambda: opened.append(5))
    for tick in range(9):
        made[0].before(None, runs.measurement(runs.setup(), 1, tick))
    assert opened == [-1, 5]


@pytest.mark.parametrize(
    ("notes", "why"),
    [
        (["one", "two"], "one; two"),
        ([], "the log has no plan of agent 1 between those ticks"),
    ],
)
def test_why_nothing_can_be_compared(
    notes: list[str], why: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The reasons of the replay, or else that there is no plan."""
    monkeypatch.setattr(Again, "notes", notes)
    monkeypatch.setattr(replay, "Replay", Again)
    monkeypatch.setattr(replay, "_compared", lambda *_: Comparison())
    assert ask(folder, "--agent", "1").stderr == f"transport: {folder}: nothing to compare: {why}\n"


def differing(*kinds: str, apart: float = 0.0) -> Comparison:
    """Return a comparison of 8 plans of the ticks 3 to 6, of which 3 differ from tick 4 on."""
    found = Comparison(ticks=[3, 4, 5, 6], plans=8, identical=5)
    for kind in kinds:
        one = Difference(
            tick=4, kind=kind, negotiation=0, name="inputs", where="UAV2, step 3", got="2.5",
            expected="2.0", size=0.5,
        )  # fmt: skip
        found.by_field[one.field] = [one]
    found.inputs_apart.append(InputsApart(5, 0.0, 0.0, 0.0, apart))
    return found


@pytest.mark.parametrize(
    ("words", "is_noted"),
    [
        ((), True),
        (("--set", "controller.weights.attitude=6.0"), False),
        (("--against", "resilient"), False),
    ],
)
@pytest.mark.parametrize(("apart", "beyond"), [(0.9e-6, None), (1.1e-6, 5)])
def test_a_difference_is_told_in_text_and_json(
    words: tuple[str, ...],
    apart: float,
    is_noted: bool,
    beyond: int | None,
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """First difference, inputs beyond rounding, fields, files; of a changed controller no other machine is noted."""
    comparison = differing("plan", "report", apart=apart)
    drawn: list[Any] = []

    def draw(setup: Any, *given: Any) -> list[Path]:
        drawn.append((setup.scenario.name, setup.scenario.controller.weights.attitude, *given))
        return [tmp_path / "replay.png"]

    monkeypatch.setattr(replay, "draw_replay", draw)
    monkeypatch.setattr(replay, "_compared", lambda *_: comparison)
    out = tmp_path / "a" / "b"
    result = ask(folder, "--agent", "2", *words, "--out", out)
    lines = [" ".join(line.split()) for line in result.stdout.splitlines()]
    assert result.exit_code == 8
    assert lines[:3] == [
        "agent2: 3 of 8 plans of ticks 3 to 6 are different from tick 4 on",
        "first: plan.inputs UAV2, step 3: got 2.5, expected 2.0",
        f"first tick with inputs that differ by more than 1e-06 (SI): {beyond or 'none'}",
    ]
    assert lines[3:6] == [
        "field ticks first tick largest where".replace("first tick", "first_tick"),
        "plan.inputs 1 4 0.5 UAV2, step 3",
        "report.inputs 1 4 0.5 UAV2, step 3",
    ]
    assert lines[6] == str(tmp_path / "replay.png")
    assert drawn == [("paper", 5.0, comparison, out)]  # in the units of the run
    assert out.is_dir()
    note = "recorded with python 3.12.1, numpy 2.0.0 on a machine, 2 cores: last digits may differ"
    notes = [note] if is_noted else []
    assert result.stderr == "".join(f"note: {text}\n" for text in notes)

    told = ask(folder, "--agent", "2", *words, "--format", "json")
    content = json.loads(told.stdout)
    first = {**asdict(comparison.by_field["plan.inputs"][0])}
    fields = content.pop("fields")
    assert [row["field"] for row in fields] == ["plan.inputs", "report.inputs"]
    assert content == {
        "run": str(folder), "agent": 2, "ticks": [3, 6], "plans": 8, "identical": 5, "first": first,
        "first_tick_beyond_rounding": beyond, "notes": notes,
    }  # fmt: skip
    assert told.stderr == ""


def test_plans_without_a_difference_have_no_figure(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reports may differ: they have a table, and the exit code is that of equal plans."""
    monkeypatch.setattr(replay, "_compared", lambda *_: differing("report"))
    result = ask(folder, "--agent", "2", "--out", tmp_path / "out")
    assert result.exit_code == 0
    first, *table = result.stdout.splitlines()
    assert first == "agent2: all 8 plans of ticks 3 to 6 are identical, bit for bit"
    assert "report.inputs" in table[1]
    assert not (tmp_path / "out").exists()


def test_a_run_beyond_the_limits_is_replayed_with_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was allowed when it was recorded; a scenario that does not fit it is named."""
    other = tmp_path / "other.toml"
    text = runs.PAPER.read_text(encoding="utf-8")
    other.write_text(text.replace("sampling_period_s = 0.05", "sampling_period_s = 0.1"))
    run: Any = SimpleNamespace(setup=runs.setup(), scenario_file=runs.PAPER)

    def read(path: Path, settings: Sequence[str], *, allow_large: bool = False) -> Any:
        assert allow_large
        return read_scenario(path, settings)

    monkeypatch.setattr(replay, "read_scenario", read)
    changed = replay._changed_setup(run, ["controller.weights.attitude=6.0"], None)
    assert changed.scenario.controller.weights.attitude == 6.0
    with pytest.raises(ScenarioError) as refused:
        replay._changed_setup(run, [], str(other))
    assert refused.value.source == str(other)


def test_another_controller_has_the_given_changes() -> None:
    """With --against, changes are made to that controller; all else is that of the run."""
    recorded = runs.setup("links.loss=0.2", "controller.horizon=9")
    run: Any = SimpleNamespace(setup=recorded, scenario_file=runs.PAPER)
    changed = replay._changed_setup(run, ["controller.horizon=7"], "resilient").scenario
    other = runs.ready("resilient", "controller.horizon=7").scenario
    assert changed.controller == other.controller
    assert changed.controller.horizon == 7
    assert (
        changed.model_copy(update={"controller": recorded.scenario.controller}) == recorded.scenario
    )


def test_the_limits_of_a_comparison_are_told() -> None:
    """Ticks without an answer, a cut log, real time, and bits of another machine where they should be equal."""
    here = {"versions": versions(), "machine": machine()}
    elsewhere = {"versions": "python 1", "machine": "another"}

    def notes(
        mode: str = "lockstep", cut: str = "", *, differs: bool, is_changed: bool, **header: str
    ) -> list[str]:
        clock = SimpleNamespace(mode=mode)
        setup = SimpleNamespace(scenario=SimpleNamespace(clock=clock))
        run: Any = SimpleNamespace(setup=setup, log=SimpleNamespace(cut=cut, header=header))
        again: Any = SimpleNamespace(notes=["of the replay"])
        comparison: Any = SimpleNamespace(
            unrecorded=[4, 7] if cut else [], first=object() if differs else None
        )
        return list(replay._notes(run, again, comparison, is_changed=is_changed))

    assert notes(differs=False, is_changed=False, **here) == ["of the replay"]
    assert notes(differs=True, is_changed=False, **here) == ["of the replay"]
    for is_changed in (False, True):
        found = notes(differs=True, is_changed=is_changed, **elsewhere)
        assert found[1:] == [
            "recorded with python 1 on another: last digits may differ",
        ] * (not is_changed)
    _, unrecorded, cut, realtime = notes(
        "realtime", "it is cut", differs=False, is_changed=False, **elsewhere
    )
    assert unrecorded.endswith("the agent (down, or at its end): tick 4, 7")
    assert cut == "it is cut"
    assert realtime.startswith("real time: exact unless")


def test_command_takes_another_controller(folder: Path) -> None:
    """--against takes the controller of another scenario, here one with corrections."""
    result = ask(folder, "--agent", "1", "--against", "resilient", "--to", "5", "--format", "json")
    assert result.exit_code == 8, result.output
    assert "plan.corrections" in [row["field"] for row in json.loads(result.stdout)["fields"]]


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (("--agent", "5"), 2, "expected an agent from 1 to 4"),
        (
            ("--agent", "1", "--set", "controller.negotiation_iterations=2"),
            3,
            "expected 1 as in the run, got 2",
        ),
        (
            ("--agent", "1", "--set", "agents.owned=[[1,2],[3,4]]"),
            3,
            "expected [[1], [2], [3], [4]] as in the run, got [[1, 2], [3, 4]]",
        ),
        (
            ("--agent", "1", "--set", "controller.sampling_period_s=0.1"),
            3,
            "expected 0.05 as in the run, got 0.1",
        ),
        (
            ("--agent", "1", "--set", "clock={mode='realtime',speed=1.0}"),
            3,
            "expected lockstep as in the run, got realtime",
        ),
        (
            ("--agent", "1", "--set", "clock.actuation=next_tick"),
            3,
            "expected immediate as in the run, got next_tick",
        ),
        (
            ("--agent", "1", "--against", "resilient", "--set", "links.loss=0.1"),
            2,
            "a value of the controller",
        ),
        (("--agent", "1", "--from", "9", "--to", "3"), 2, "nothing to compare"),
        (("--agent", "1", "--from", "900"), 2, "nothing to compare"),
    ],
)
def test_command_refuses(folder: Path, arguments: tuple[str, ...], code: int, text: str) -> None:
    """Wrong arguments are refused in one line with expected and got."""
    result = ask(folder, *arguments)
    assert result.exit_code == code
    assert text in result.output


@pytest.mark.parametrize("share", [0.0, 0.02, 0.1, 0.2, 0.5, 0.9])
def test_a_log_cut_anywhere_is_replayed_or_refused(tmp_path: Path, share: float) -> None:
    """The part that is left is compared; before the first roster nothing is, in one line with exit code 2."""
    logs.record_run(runs.setup(runs.SHORT), tmp_path)
    log = tmp_path / "run.mcap"
    whole = log.read_bytes()
    log.write_bytes(whole[: int(share * len(whole))])
    result = CliRunner().invoke(app, ["replay", str(tmp_path), "--agent", "1"])
    if result.exit_code == 0:
        return
    assert result.exit_code == 2
    (line,) = result.stderr.splitlines()
    assert line.startswith(f"transport: {tmp_path}")


def test_a_log_without_a_roster_has_nothing_to_compare(tmp_path: Path) -> None:
    """An agent that no roster admits has no process: one line, exit code 2."""
    run = runs.setup(runs.SHORT)
    tick = logs.log_of([runs.tick(0), runs.measurement(run, 1, 0)])
    again = Replay(run, tick, 1)
    assert list(again.steps()) == []
    assert again.notes == ["agent1 is on no roster in the log"]


def test_another_version_of_a_class_of_the_user_is_noted() -> None:
    """Its name is that of the scenario; the log of a run with the same version has no note."""
    name = "tests.support.own_classes:Chain"
    run = runs.setup(runs.SHORT, f"agents.controller={name}")
    for recorded_with, notes in (
        (f"{name} 1", []),
        (f"{name}s 0", []),  # of another class
        (f"{name} 0", [f"the run was recorded with controller {name} 0, this is {name} 1"]),
    ):
        log = logs.log_of([runs.roster()])
        again = Replay(run, replace(log, header={"controller": recorded_with}), 1)
        assert list(again.steps()) == []
        assert again.notes == notes


@pytest.mark.parametrize(
    ("before", "follows"), [(None, True), ((4, 1), True), ((3, 1), False), ((2, 0), True)]
)
def test_a_measurement_follows_the_one_of_the_tick_before(
    before: tuple[int, int] | None, *, follows: bool
) -> None:
    """Or that of another roster, as an agent that was off the roster had none; the first one follows none."""
    run = runs.setup(runs.SHORT)
    measurement = runs.measurement(run, 1, 5, version=1)
    earlier = None if before is None else runs.measurement(run, 1, before[0], version=before[1])
    assert _follows(measurement, earlier) is follows


@pytest.mark.parametrize(("version", "due"), [(0, 0), (1, 2), (2, 4), (3, 4)])
def test_changes_are_due_with_the_roster_that_a_measurement_names(version: int, due: int) -> None:
    """Those after it wait for the next one, with which they take effect."""
    change = LinkChange(
        sender="coordinator", incarnation=0, sequence=0, tick=3, number=1, source="", target="",
        settings="{}",
    )  # fmt: skip
    changes: list[Message] = [
        *(change, runs.roster()),
        *(change, runs.roster(k=4, version=2)),
        change,
    ]
    measurement = runs.measurement(runs.setup(runs.SHORT), 1, 4, version=version)
    assert _due_changes(changes, measurement) == due
