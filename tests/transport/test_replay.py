"""`transport replay`: the same bits from the same messages, and the first difference where there is one."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from protocol.wire.messages import FaultNote, Message, Plan, StepReport
from tests.support import logs, runs
from transport.analysis.replay import Replay
from transport.analysis.replay_compare import Comparison, differences
from transport.cli.main import app
from transport.log.run_log import RunLog

CLOSED_LOOP = ("controller.prediction='closed_loop'", "controller.relaxation='auto'")
POOR_LINKS = ("links.delay_s=0.06", "links.jitter_s=0.1", "links.loss=0.2", "links.duplicate=0.1", "links.reorder=0.1")
TROUBLE = (
    *("clock.on_agent_loss='continue'", "links.measurement.delay_s=0.1"),
    "faults.event=[{at_s=0.2,do='kill',target='agent3'},{at_s=0.5,do='restart',target='agent3'},"
    "{at_s=0.6,do='stop',target='agent2'},{at_s=0.9,do='continue',target='agent2'}]",
    "links.change=[{at_s=0.7,from='agent1',to='agent2',loss=0.9}]",
)
# What the reports of a real-time flight cannot be compared in: when a loss was noticed was recorded nowhere.
UNKNOWN_IN_REAL_TIME = ("report.lost",)


def flight(*settings: str) -> RunLog:
    """The log of a flight in this process."""
    return logs.log_of(runs.recorded(runs.setup(runs.SHORT, *settings)))


def compared(log: RunLog, agent: int, *settings: str, ignored: Sequence[str] = ()) -> tuple[Replay, Comparison]:
    """A replay to its end, as flown with some settings."""
    again, comparison = Replay(runs.setup(runs.SHORT, *settings), log, agent), Comparison()
    for step in again.steps():
        comparison.add(step, ignored=ignored)
    return again, comparison


def plans(log: RunLog, agent: int) -> list[Plan]:
    """An agent's plans."""
    return [plan for plan in log.of(Plan) if plan.agent == agent]


@pytest.mark.parametrize(
    "settings",
    [
        (),
        (*CLOSED_LOOP, *POOR_LINKS, *TROUBLE),
        (*CLOSED_LOOP, "controller.negotiation_iterations=2", "links.loss=0.3"),
    ],
    ids=["as printed", "poor links, killed, frozen", "negotiation_iterations"],
)
def test_what_was_flown_is_flown_again(settings: tuple[str, ...]) -> None:
    """In lockstep an agent that hears what it heard says what it said, plans and reports, to the last bit."""
    log = flight(*settings)
    for agent in runs.EVERYBODY:
        again, comparison = compared(log, agent, *settings)
        assert comparison.tallies == {}
        assert comparison.plans == comparison.identical == len(plans(log, agent))
        assert again.notes == []


def test_order_of_the_log_does_not_matter() -> None:
    """The recorder hears senders in another order than the agent: within a tick any will do, as in lockstep itself."""
    settings = (*CLOSED_LOOP, *POOR_LINKS, *TROUBLE)
    log = flight(*settings)
    backwards = sorted(enumerate(log.messages), key=lambda e: (e[1].message.tick, e[1].message.sender, e[0]))
    shuffled = replace(log, messages=tuple(entry for _, entry in backwards))
    for agent in (2, 3):
        assert compared(shuffled, agent, *settings)[1].tallies == {}


def test_real_time_is_flown_again_from_what_reports_say() -> None:
    """In real time the reports tell which plans an agent had, whenever those reached the recorder."""
    settings = ("clock.mode='realtime'", "clock.speed=1.0", "clock.actuation='next_tick'", "links.loss=0.2")
    log = flight(*settings)
    # To the recorder all plans come a moment before everything else that is of their tick.
    ordered = sorted(log.messages, key=lambda entry: (entry.message.tick, not isinstance(entry.message, Plan)))
    for agent in (1, 3):
        log = replace(log, messages=tuple(ordered))
        _, comparison = compared(log, agent, *settings, ignored=UNKNOWN_IN_REAL_TIME)
        assert comparison.tallies == {}
        assert comparison.identical == len(plans(log, agent)) > 0


def test_one_bit_is_found() -> None:
    """A recorded number that is off by its last bit is named with tick, field, entry, both values and the size."""
    log = flight()
    victim = next(plan for plan in plans(log, 2) if plan.tick == 7)
    inputs = victim.inputs.copy()
    inputs[3, 0] = np.nextafter(inputs[3, 0], np.inf)
    changed = replace(victim, inputs=inputs)
    log = logs.log_of([changed if entry.message is victim else entry.message for entry in log.messages])
    _, comparison = compared(log, 2)
    first = comparison.first
    assert first is not None
    assert (first.tick, first.field, first.unit) == (7, "plan.inputs", "N")
    assert "UAV2 thrust, step 3" in first.where
    assert (float(first.expected), float(first.got)) == (inputs[3, 0], victim.inputs[3, 0])
    assert first.size == inputs[3, 0] - victim.inputs[3, 0] > 0.0
    assert comparison.plans - comparison.identical == 1


def test_zero_and_minus_zero_differ() -> None:
    """Bit for bit means that 0 and -0 are two numbers, although nothing lies between them."""
    run = runs.setup(runs.SHORT)
    one = runs.plan(run, 1, 3, inputs=np.zeros((2, 4)))
    found = list(differences(replace(one, inputs=-one.inputs), one))
    assert [(entry.name, entry.size) for entry in found] == [("inputs", 0.0)]


def test_another_weight_shows_when_there_is_something_to_weigh() -> None:
    """With a weight changed all plans differ by rounding, and by more from where that weight has an error to act on."""
    log = flight()
    _, comparison = compared(log, 2, "controller.weights.position=1.5")
    assert comparison.first is not None
    beyond = comparison.first_beyond(1e-6)
    assert beyond is not None
    # 0.5 s of hover at rest, seen a horizon of 1 s ahead: the climb shows at once; the sizes grow with it.
    assert comparison.first.tick <= beyond < 20
    assert comparison.tallies["plan.inputs"].largest.size is not None


def test_what_cannot_be_fed_ends_the_replay() -> None:
    """Where a plan is missing that the agent waited for, the replay stops there and says so; what was before counts."""
    log = flight()
    messages = [entry.message for entry in log.messages]
    lost = next(plan for plan in plans(log, 3) if plan.tick == 9)
    kept = [message for message in messages if message is not lost]
    again, comparison = compared(logs.log_of(kept), 1)
    assert comparison.ticks == list(range(10))
    assert comparison.tallies == {}
    assert len(again.notes) == 1
    assert "tick 10 cannot be replayed" in again.notes[0]


def test_thawed_agent_is_the_same_process() -> None:
    """A log that notes an agent as continued has it go on as the process it was, one that is restarted as a new one."""
    settings = (*CLOSED_LOOP, *TROUBLE)
    log = flight(*settings)
    nodes: list[object] = []
    for what, processes in (("continued", 1), ("restarted", 2)):
        note = FaultNote(
            sender="recorder", incarnation=0, sequence=0, tick=17, target="agent2", what=what, origin="script"
        )
        messages: list[Message] = [entry.message for entry in log.messages]
        again = Replay(
            runs.setup(runs.SHORT, *settings),
            logs.log_of([*messages, note]),
            2,
            lambda node, _: nodes.append(node),
        )
        assert [step.tick for step in again.steps()] == [*range(13), *range(18, 30)]
        assert len(set(map(id, nodes))) == processes
        nodes.clear()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder."""
    path = tmp_path_factory.mktemp("replay") / "run"
    logs.flown(runs.setup(runs.SHORT), path)
    return path


def ask(*arguments: str | Path) -> Result:
    """The command in this process."""
    return CliRunner().invoke(app, ["replay", *map(str, arguments)])


def test_command_says_identical(folder: Path) -> None:
    """An untouched run: exit code 0, and the sentence people look for."""
    result = ask(folder, "--agent", "2")
    assert result.exit_code == 0, result.output
    assert "all 30 plans of ticks 0 to 29 are identical, bit for bit" in result.output


def test_command_names_the_first_tick(folder: Path, tmp_path: Path) -> None:
    """With one weight changed: exit code 8, the first tick, a table, a figure, and the same as JSON."""
    what_if = (folder, "--agent", "2", "--set", "controller.weights.attitude=6.0")
    result = ask(*what_if, "--from", "3", "--out", tmp_path)
    assert result.exit_code == 8
    assert "differ from tick 3 on" in result.output
    assert {path.name for path in tmp_path.iterdir()} == {"replay.csv", "replay.png", "replay.svg"}
    assert len((tmp_path / "replay.csv").read_text().splitlines()) == 1 + 27
    content = json.loads(ask(*what_if, "--format", "json").stdout)
    assert content["first"]["tick"] == 0
    assert content["first"]["kind"] == Plan.kind
    assert content["plans"] == 30


def test_command_takes_another_controller(folder: Path) -> None:
    """--against asks the controller of another scenario what it would have done: here one with corrections."""
    result = ask(folder, "--agent", "1", "--against", "resilient", "--to", "5", "--format", "json")
    assert result.exit_code == 8, result.output
    assert "plan.corrections" in json.loads(result.stdout)["fields"]


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (("--agent", "5"), 2, "expected an agent from 1 to 4"),
        (("--agent", "1", "--set", "controller.negotiation_iterations=2"), 3, "expected 1 as in the run, got 2"),
        (("--agent", "1", "--against", "resilient", "--set", "links.loss=0.1"), 2, "a value of the controller"),
        (("--agent", "1", "--from", "9", "--to", "3"), 2, "--to: expected a tick not before --from 9"),
        (("--agent", "1", "--from", "900"), 2, "nothing to compare"),
    ],
)
def test_command_refuses(folder: Path, arguments: tuple[str, ...], code: int, text: str) -> None:
    """What cannot be asked is refused in one line, with what was expected and what came."""
    result = ask(folder, *arguments)
    assert result.exit_code == code
    assert text in result.output


def test_step_reports_have_wall_clocks_that_do_not_count() -> None:
    """Two reports that differ in their times alone are the same."""
    report = logs.report(runs.setup(), 1, 4)
    assert list(differences(replace(report, times_ms=report.times_ms * 2.0), report)) == []
    found = list(differences(replace(report, iterations=9), report))
    assert [(entry.field, entry.size) for entry in found] == [(f"{StepReport.kind}.iterations", 7.0)]
