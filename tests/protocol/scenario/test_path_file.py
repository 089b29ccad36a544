"""Paths from files: flown as tabulated, part of the scenario once read, refused with the row and the reason."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from tests.support.runs import PAPER, completed, plant_states
from transport.model import state
from transport.protocol.scenario.files.named_files import TableError, delays_of, points_of, way_of
from transport.protocol.scenario.scenario_file import ScenarioError, read_scenario
from transport.protocol.scenario.setup.run_setup import Setup

HEADING = "t_s,x_m,y_m,z_m\n"
# A quarter of a circle of 2 m radius, 0.4 m/s on average, one row per sampling period; from a place
# of its own.
T = np.linspace(0.0, 8.0, 161)
ANGLE = np.pi / 2.0 * (T / 8.0)
QUARTER = np.column_stack(
    [T + 100.0, 5.0 + 2.0 * np.sin(ANGLE), 2.0 - 2.0 * np.cos(ANGLE), -30.0 - 0.05 * T]
)


def written(folder: Path, text: str) -> Path:
    """A scenario that hovers, flies `way.csv`, and hovers."""
    (folder / "way.csv").write_text(text, encoding="utf-8")
    phases = (
        "[[maneuver.phase]]\nname='hover'\nduration_s=1.0\ndisplacement_m=[0,0,0]\n"
        "[[maneuver.phase]]\nname='turn'\nfile='way.csv'\n"
        "[[maneuver.phase]]\nname='wait'\nduration_s=1.0\ndisplacement_m=[0,0,0]\n"
    )
    paper = PAPER.read_text(encoding="utf-8")
    begin, end = paper.index("[[maneuver.phase]]"), paper.index("[controller]")
    (folder / "scenario.toml").write_text(paper[:begin] + phases + paper[end:], encoding="utf-8")
    return folder / "scenario.toml"


def csv(rows: np.ndarray) -> str:
    """A path as text, every digit kept."""
    return HEADING + "".join(",".join(map(repr, map(float, row))) + "\n" for row in rows)


def test_a_path_is_the_reference_where_it_has_rows(tmp_path: Path) -> None:
    """The payload's path passes every row at its time, counted from the end of the phase before, from any origin."""
    path = written(tmp_path, csv(QUARTER))
    maneuver = Setup.of(read_scenario(path), str(path)).maneuver
    assert maneuver.duration_s == pytest.approx(10.0)
    r, _ = maneuver.path(1.0 + T)
    assert r == pytest.approx(QUARTER[:, 1:] - QUARTER[0, 1:] + maneuver.start_I, abs=1e-9)
    # Halfway between rows, where nothing rounds to the other side of a corner: constant speed from
    # one to the next.
    middle, speed = maneuver.path(1.0 + (T[1:] + T[:-1]) / 2.0)
    assert middle == pytest.approx((r[1:] + r[:-1]) / 2.0, abs=1e-9)
    assert speed == pytest.approx(np.diff(r, axis=0) / 0.05, abs=1e-6)
    before, after = maneuver.path(np.array([0.0, 0.99])), maneuver.path(np.array([9.01, 50.0]))
    assert not before[1].any()
    assert not after[1].any()
    assert before[0] == pytest.approx(np.tile(maneuver.start_I, (2, 1)))
    assert after[0] == pytest.approx(np.tile(r[-1], (2, 1)))


def test_a_path_is_flown(tmp_path: Path) -> None:
    """The team follows it as it follows phases.

    The error is at most the swing of a straight path of that speed.
    """
    path = written(tmp_path, csv(QUARTER))
    run = Setup.of(
        read_scenario(path, ["controller.prediction=closed_loop", "controller.relaxation=0.25"]),
        str(path),
    )
    x = np.array([plant_state.x for plant_state in plant_states(completed(run))])
    r, _ = run.maneuver.path(run.settings.sampling_period_s * np.arange(len(x), dtype=np.float64))
    assert np.linalg.norm(x[:, state.R0] - r, axis=1).max() < 0.6
    assert np.degrees(np.abs(x[:, state.THETA0])).max() < 2.5


def test_the_scenario_stands_for_itself_once_read(tmp_path: Path) -> None:
    """Written back and read without the file it is equal, with the same fingerprint.

    A run folder needs no copy.
    """
    path = written(tmp_path, csv(QUARTER))
    scenario = read_scenario(path)
    (tmp_path / "way.csv").unlink()
    again = tmp_path / "again.toml"
    again.write_text(tomli_w.dumps(scenario.tree()), encoding="utf-8")
    assert read_scenario(again).digest() == scenario.digest()
    assert "file" not in scenario.tree()["maneuver"]["phase"][1]


ROW = "0,0,0,0\n"
GARBAGE = [
    ("", "expected the heading t_s,x_m,y_m,z_m, got nothing"),
    ("0,0,0,0\n1,0,0,0\n", "expected the heading t_s,x_m,y_m,z_m, got '0,0,0,0'"),
    (HEADING, "expected rows of numbers t_s,x_m,y_m,z_m, got none"),
    (HEADING + ROW, "duration_s: expected greater than 0, got 0.0"),
    (HEADING + ROW + "1,2,x,3\n", "row 3, column y_m: expected a finite number, got 'x'"),
    (HEADING + "0,0,0,nan\n1,2,3,4\n", "row 2, column z_m: expected a finite number, got 'nan'"),
    (HEADING + ROW + "1,inf,3,4\n", "row 3, column x_m: expected a finite number, got 'inf'"),
    (HEADING + ROW + "\n1,2,,4\n", "row 4, column y_m: expected a finite number, got nothing"),
    (HEADING + ROW + "1, 2 2,3,4\n", "row 3, column x_m: expected a finite number, got '2 2'"),
    (HEADING + ROW + "1,1_0,3,4\n", "row 3, column x_m: expected a finite number, got '1_0'"),
    (HEADING + ROW + "1,2,3,4,\n", "row 3: expected 4 numbers t_s,x_m,y_m,z_m, got 5 cells"),
    (HEADING + ROW + "1,2,3\n", "row 3: expected 4 numbers t_s,x_m,y_m,z_m, got 3 cells '1,2,3'"),
]


@pytest.mark.parametrize(("text", "problem"), GARBAGE)
def test_garbage_is_refused_with_row_and_reason(text: str, problem: str, tmp_path: Path) -> None:
    """An invalid path is refused on reading, in one line.

    It has scenario, key, file, row, column, expected and got.
    """
    path = written(tmp_path, text)
    with pytest.raises(ScenarioError) as caught:
        read_scenario(path)
    assert str(caught.value).startswith(f"{path}: maneuver.phase.2")
    assert problem in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_table_of_a_spreadsheet_is_read(tmp_path: Path) -> None:
    """A byte order mark, blanks around numbers, blank lines and line ends of Windows change nothing."""
    plain = written(tmp_path, "t_s,x_m,y_m,z_m\n0,0,0,0\n2,1,0,0\n")
    expected = read_scenario(plain).digest()
    (tmp_path / "way.csv").write_bytes(
        b"\xef\xbb\xbft_s, x_m, y_m, z_m\r\n 0, 0 ,0,0\r\n\r\n2,1,0,0\r\n"
    )
    plain.write_bytes(b"\xef\xbb\xbf" + plain.read_bytes())
    assert read_scenario(plain).digest() == expected


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="a file without end")
def test_a_file_without_end_is_refused(tmp_path: Path) -> None:
    """A device or a file beyond the size of its kind is refused once that size is read."""
    path = written(tmp_path, csv(QUARTER))
    (tmp_path / "way.csv").unlink()
    (tmp_path / "way.csv").symlink_to("/dev/zero")
    with pytest.raises(ScenarioError, match=r"way\.csv \(expected at most 10 MB, got more\)"):
        read_scenario(path)
    with pytest.raises(ScenarioError, match=r"zero: cannot be read \(expected at most 10 MB"):
        read_scenario(Path("/dev/zero"))


def test_a_path_that_is_not_there_is_refused(tmp_path: Path) -> None:
    """A missing file, a folder or bytes are named as such, with the setting if it gave the name."""
    path = written(tmp_path, csv(QUARTER))
    with pytest.raises(
        ScenarioError,
        match=r"^--set maneuver.phase.2.file=no.csv: maneuver.phase.2: cannot read .*no.csv \(No such file",
    ):
        read_scenario(path, ["maneuver.phase.2.file=no.csv"])
    with pytest.raises(ScenarioError, match=r"cannot read .* \(Is a directory\)"):
        read_scenario(path, ["maneuver.phase.2.file=."])
    (tmp_path / "way.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ScenarioError, match=r"cannot read .* .'utf-8' codec can't decode"):
        read_scenario(path)


@pytest.mark.parametrize(
    "key", ["duration_s=3.0", "displacement_m=[0.0,0.0,0.0]", "way=[[0.0,0.0,0.0,0.0]]"]
)
def test_a_phase_has_one_way(key: str, tmp_path: Path) -> None:
    """A phase with a file takes duration and displacement from it and from nowhere else."""
    path = written(tmp_path, csv(QUARTER))
    name = key.partition("=")[0]
    with pytest.raises(ScenarioError, match=f"expected no {name} next to `file`, which defines it"):
        read_scenario(path, [f"maneuver.phase.2.{key}"])


WRONG_WAYS = [
    ("[[0,0,0,0],[1,0,0,0.5]]", "expected rows from [0.0, 0.0, 0.0, 0.0] to [1.0, 0.0, 0.0, 1.0]"),
    ("[[0,0,0,0]]", "expected rows from"),
    ("[[0,0,0,0],[0.5,0,0],[1,0,0,1]]", "expected an array of numbers"),
    ("[[0,0,0,0],[0.5,0,0,0],[0.5,0,0,0],[1,0,0,1]]", "row 3: expected a time > 0.5 s, got 0.5"),
]


@pytest.mark.parametrize(("way", "problem"), WRONG_WAYS)
def test_a_way_that_does_not_fit_is_refused(way: str, problem: str) -> None:
    """A table given in the scenario itself has to go from zeros to duration and displacement, forward in time."""
    phase = f"maneuver.phase=[{{name='turn',duration_s=1.0,displacement_m=[0,0,1],way={way}}}]"
    with pytest.raises(ScenarioError, match="maneuver: phase 'turn' way") as caught:
        Setup.of(read_scenario(PAPER, [phase]), str(PAPER))
    assert problem in str(caught.value)


def circle() -> Any:
    """A closed circle as a computation gives it: its last position is zero but for rounding."""
    t = np.linspace(0.0, 2.0, 41)
    a = np.pi * t
    return np.stack([t, np.cos(a) - 1.0, np.sin(a), 0.0 * t], axis=1).tolist()


@pytest.mark.parametrize(
    "ends", ["", "duration_s=2.0,displacement_m=[0,0,0],"], ids=["from the table", "given"]
)
def test_a_table_is_enough(ends: str) -> None:
    """A phase with a table needs no duration and displacement.

    Those given may differ from its ends by rounding.
    """
    way = circle()
    assert way[-1][2] != 0.0
    run = Setup.of(
        read_scenario(PAPER, [f"maneuver.phase=[{{name='round',{ends}way={way}}}]"]), str(PAPER)
    )
    assert run.maneuver.duration_s == 2.0
    r, _ = run.maneuver.path(np.array([0.0, 1.0, 2.0]))
    assert r - r[0] == pytest.approx(np.array([[0, 0, 0], [-2, 0, 0], [0, 0, 0]]), abs=1e-12)


@pytest.mark.parametrize("below", [True, False], ids=["below the scenario", "elsewhere"])
def test_files_of_settings_are_the_callers(
    below: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file named by a setting is relative to the current folder, one in the scenario to the scenario's folder."""
    scenario = written(tmp_path, csv(QUARTER))
    here = tmp_path / "below" if below else tmp_path.parent / f"{tmp_path.name}-elsewhere"
    here.mkdir()
    monkeypatch.chdir(here)
    (here / "circle.csv").write_text(csv(np.array(circle())), encoding="utf-8")
    (here / "delays.csv").write_text("0.1, 0.2", encoding="utf-8")
    settings = ["links.distribution=empirical", "links.samples_s=delays.csv"]
    read = read_scenario(scenario, [*settings, "maneuver.phase=[{name='round',file='circle.csv'}]"])
    assert read.links.samples_s == [0.1, 0.2]
    assert read.maneuver.phase[0].duration_s == 2.0

    (here / "roof.csv").write_text("t_s,delay_s\n0.0,0.02\n1.0,0.03\n", encoding="utf-8")
    for setting in ("links.trace=roof.csv", "links={trace='roof.csv'}"):
        assert read_scenario(scenario, [setting]).links.trace == [[0.0, 0.02], [1.0, 0.03]]
    assert read_scenario(scenario, ["maneuver.phase.2.name=turn"]).maneuver.phase[1].way is not None


@pytest.mark.parametrize(
    ("text", "times_s"),
    [("x,y,z\n1,2,-3\n4,5,-6\n", None), ("t, x, y, z\n0.5,1,2,-3\n\n9,4,5,-6\n", [0.5, 9.0])],
)
def test_way_points_come_with_or_without_times(
    text: str, times_s: list[float] | None, tmp_path: Path
) -> None:
    """A table of way points has the columns of a place, and may have one of times before them."""
    file = tmp_path / "points.csv"
    file.write_text(text, encoding="utf-8")
    assert points_of(file) == ([[1.0, 2.0, -3.0], [4.0, 5.0, -6.0]], times_s)


def test_measured_delays_are_in_ascending_order(tmp_path: Path) -> None:
    """The order of a file changes no draw from it."""
    file = tmp_path / "delays.csv"
    file.write_text("0.5, 0.02\n0.01 0.3,\n", encoding="utf-8")
    assert delays_of(file) == [0.01, 0.02, 0.3, 0.5]


def test_a_path_is_relative_to_its_first_row(tmp_path: Path) -> None:
    """Times and positions of a recorded path begin at zero; without rows there is none."""
    file = tmp_path / "path.csv"
    file.write_text("t_s,x_m,y_m,z_m\n2,1,2,-3\n5,2,4,-6\n", encoding="utf-8")
    assert way_of(file) == [[0.0, 0.0, 0.0, 0.0], [3.0, 1.0, 2.0, -3.0]]
    file.write_text("t_s,x_m,y_m,z_m\n", encoding="utf-8")
    with pytest.raises(TableError, match="expected rows of numbers t_s,x_m,y_m,z_m, got none"):
        way_of(file)
