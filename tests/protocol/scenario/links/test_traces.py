"""Traces of links: recorded delays and losses, in their order."""

import importlib.util
import threading
from pathlib import Path

import pytest

from tests.support.runs import setup
from transport.protocol.scenario.files.bounded_reading import MOST_TEXT
from transport.protocol.scenario.files.named_files import LOST_S, TableError, trace_of
from transport.protocol.scenario.links.delay_jitter_and_loss import traced_delay_s
from transport.protocol.scenario.scenario_file import ScenarioError, validate
from transport.protocol.scenario.setup.run_setup import Setup

TRACE = "links.trace=[[0.0,0.01],[0.05,0.3],[0.1,-1.0],[0.15,0.02]]"
EXAMPLE = Path(__file__).resolve().parents[4] / "examples" / "record_link.py"


def test_a_trace_is_followed_and_repeated() -> None:
    """Messages have the delays of the rows at their instants, lost ones none, and again from the start."""
    link = setup(TRACE).rules.link("agent1", "agent2")
    delays = [link.delays(tick) for tick in range(8)]
    assert delays == 2 * [[0.01], [0.3], [], [0.02]]


@pytest.mark.parametrize(
    "besides", ["jitter_s=0.5", "delay_s=0.2", "distribution='empirical',samples_s=[0.2]"]
)
def test_recorded_delays_take_the_place_of_others(besides: str) -> None:
    """Those of the trace are the whole delays, also where there is none."""
    link = setup(f"links={{trace=[[0.0,0.0],[0.05,0.3]],{besides}}}").rules.link("agent1", "agent2")
    assert [link.delays(tick) for tick in range(3)] == [[0.0], [0.3], [0.0]]


def test_rows_hold_until_the_next() -> None:
    """Between two rows the earlier one holds; the last one as long as the one before."""
    trace = [[1.0, 0.1], [1.2, 0.2], [1.5, 0.3]]
    at_s = {0.0: 0.1, 0.19: 0.1, 0.2: 0.2, 0.49: 0.2, 0.5: 0.3, 0.79: 0.3, 0.8: 0.1}
    assert {t_s: traced_delay_s(trace, t_s) for t_s in at_s} == at_s


def test_losses_act_beside_a_trace() -> None:
    """Loss of the link takes messages that the trace has delivered."""
    link = setup(TRACE, "links.loss=1.0").rules.link("agent1", "agent2")
    assert [link.delays(tick) for tick in range(4)] == [[], [], [], []]


@pytest.mark.parametrize("before", [TRACE, "links={distribution='empirical',samples_s=[0.3,0.4]}"])
@pytest.mark.parametrize(
    ("given", "delays_s"),
    [
        ("delay_s=0.6", (0.6, 0.6)),
        ("jitter_s=0.2", (0.0, 0.1)),
        ("distribution='normal'", (0.0, 0.0)),
        ("distribution='empirical',samples_s=[0.7]", (0.7, 0.7)),
        ("delay_s=0.1,trace=[[0.0,0.8],[1.0,0.8]]", (0.8, 0.8)),
    ],
)
def test_a_delay_given_later_takes_the_place_of_recorded_ones(
    before: str, given: str, delays_s: tuple[float, float]
) -> None:
    """From the change on messages have its delay; a change of the loss leaves the recorded ones."""
    change = f"links.change=[{{at_s=0.1,loss=0.0}},{{at_s=0.2,{given}}}]"
    link = setup(before, change).rules.link("agent1", "agent2")
    assert {delay for tick in range(4) for delay in link.delays(tick)} <= {0.01, 0.02, 0.3, 0.4}
    least_s, most_s = delays_s
    assert all(
        least_s <= delay_s <= most_s for tick in range(4, 8) for delay_s in link.delays(tick)
    )


def test_a_trace_comes_from_a_file(tmp_path: Path) -> None:
    """A file is read relative to the scenario; garbage in it is refused with its name."""
    tree = setup().scenario.tree()
    tree["links"] = {"override": [{"from": "agent2", "trace": "roof.csv"}]}
    source = str(tmp_path / "scenario.toml")
    (tmp_path / "roof.csv").write_text("t_s,delay_s\n0.0,0.02\n0.05,lost\n")
    built = Setup.of(validate(tree, source), source)
    assert built.rules.link("agent2", "agent1").delays(0) == [0.02]
    assert built.rules.link("agent2", "agent1").delays(1) == []
    assert built.rules.link("agent1", "agent2").delays(1) == [0.0]
    for content in (
        "0.0,0.02\n0.05,0.1\n",
        "t_s,delay_s\n0.0,0.1\n",
        "t_s,delay_s\n0.1,0.1\n0.0,0.1\n",
        "t_s,delay_s\n0.0,0.1\n0.1,soon\n",
        "t_s,delay_s\n-1.0,0.1\n0.0,0.1\n",
    ):
        (tmp_path / "roof.csv").write_text(content)
        with pytest.raises(ScenarioError, match="trace"):
            Setup.of(validate(tree, source), source)
    # Rows of a file are counted from its heading on.
    (tmp_path / "roof.csv").write_text("t_s,delay_s\n0.0,12\n0.1,0.1\n")
    with pytest.raises(ScenarioError, match=r"roof\.csv: row 2: expected seconds, at most 10"):
        Setup.of(validate(tree, source), source)


def test_a_table_of_a_trace_is_read_as_all_tables(tmp_path: Path) -> None:
    """A byte order mark and blanks are ignored; a bad cell is named, and a large file is not read."""
    path = tmp_path / "roof.csv"
    path.write_text("\ufefft_s, delay_s\n0.0, 0.02\n  \n0.05, lost \n", encoding="utf-8")
    assert trace_of(path) == [[0.0, 0.02], [0.05, LOST_S]]
    for content, problem in (
        ("t_s,delay_s\n0.0,0.1\n0.1,soon\n", "row 3, column delay_s: expected a finite number"),
        ("t_s,delay_s\n0.0,nan\n", "row 2, column delay_s: expected a finite number"),
        ("t_s,delay_s\n0.0\n", "row 2: expected 2 numbers t_s,delay_s, got 1 cells"),
        ("", "expected the heading t_s,delay_s, got nothing"),
        ("t_s,delay_s\n" + "0" * MOST_TEXT, "expected at most 10 MB, got more"),
    ):
        path.write_text(content)
        with pytest.raises(TableError, match=problem):
            trace_of(path)


@pytest.mark.parametrize(
    ("rows", "problem"),
    [
        ("[[0.0,0.1]]", "at least two rows of a time and a delay, got 1"),
        ("[[0.0,0.1],[0.1,0.2],[0.2]]", r"row 3: expected a time and a delay, got \[0.2\]"),
        ("[[0.1,0.1],[0.0,0.2]]", "row 2: expected rising times from 0 on, got 0 s"),
        ("[[0.0,0.1],[0.0,0.2]]", "row 2: expected rising times from 0 on, got 0 s"),
        ("[[0.0,0.1,0.2],[0.1,0.2]]", r"row 1: expected a time and a delay, got \[0.0, 0.1, 0.2\]"),
        ("[[0.0,10.0],[0.1,10.1]]", "row 2: expected seconds, at most 10, got 10.1"),
        ("[[-0.1,0.1],[0.0,0.2]]", "row 1: expected rising times from 0 on, got -0.1 s"),
    ],
)
def test_the_first_bad_row_is_named(rows: str, problem: str) -> None:
    """Rows of a trace that are refused are told with their number."""
    with pytest.raises(ScenarioError, match=problem):
        setup(f"links.trace={rows}")


def test_the_example_records_a_trace(tmp_path: Path) -> None:
    """The example's recorder and answerer write a trace of the loopback that a scenario accepts."""
    spec = importlib.util.spec_from_file_location("record_link", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)

    path = tmp_path / "trace.csv"
    answerer = threading.Thread(target=example.answer, args=(example.PORT, 4), daemon=True)
    answerer.start()
    example.record("127.0.0.1", str(path), seconds=0.2)
    heading, *rows = path.read_text().splitlines()
    assert heading == "t_s,delay_s"
    assert [row.split(",")[0] for row in rows] == ["0.000", "0.050", "0.100", "0.150"]
    assert setup(f"links.trace={path}").scenario.links.trace is not None
