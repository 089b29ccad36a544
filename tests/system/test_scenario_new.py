"""`transport scenario new`: files that run, and refusals with option, expected and got."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from tests.support.results import here
from tests.support.runs import PAPER, SCENARIOS
from transport.cli.commands.scenario import wide_load
from transport.protocol.scenario.scenario_file import read_scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.teams.team_of_any_size import Team, given_values, resized

USAGE, SCENARIO = 2, 3

# A vehicle with a text among its limits.
MINE = """
name = "mine"
uav = {mass_kg = 1.2, inertia_kgm2 = [0.01, 0.01, 0.02], rod_length_m = 2.0, spacing_m = 0.8}
controller.limits = {thrust_N = [0.0, 15.0], moments_Nm = [0.5, 0.5, "0.2"]}
"""
NEW = ("scenario", "new")
RESILIENT = SCENARIOS / "resilient.toml"

REFUSED = [
    (
        ("--uavs", "1"),
        USAGE,
        "invalid value for '--uavs': expected greater than or equal to 2, got '1'",
    ),
    (
        ("--uavs", "257"),
        USAGE,
        "invalid value for '--uavs': expected less than or equal to 256, got '257'",
    ),
    (("--uavs", "3", "--groups", "0"), USAGE, "invalid value for '--groups'"),
    (
        ("--uavs", "3", "--load", "inf"),
        SCENARIO,
        "--load inf: system.payload.mass_kg: expected a finite",
    ),
    (("--uavs", "3", "--name", "a b"), SCENARIO, "--name a b: name: string should match pattern"),
    (
        ("--uavs", "4", "--load", "50"),
        SCENARIO,
        "--load 50: controller.limits.thrust_N: expected a range that contains the hover thrust",
    ),
    (
        ("--uavs", "4", "--vehicle", "x500", "--load", "50"),
        SCENARIO,
        "--load 50: controller.limits.thrust_N: expected a range that contains the hover thrust",
    ),
    (
        ("--uavs", "4", "--vehicle", "mine.toml", "--load", "1"),
        SCENARIO,
        "mine.toml: controller.limits.moments_Nm.3: expected a number in N m, got '0.2'",
    ),
    (
        ("--uavs", "4", "--vehicle", "mine.toml", "--name", "good"),
        SCENARIO,
        "mine.toml: controller.limits.moments_Nm.3: expected a number in N m, got '0.2'",
    ),
    (
        ("--uavs", "3", "--out", "there.toml"),
        USAGE,
        "--out: expected a file that does not exist yet, got there.toml",
    ),
    (
        ("--uavs", "3", "--out", "no/where.toml"),
        USAGE,
        "--out: cannot write no/where.toml (No such file or directory)",
    ),
    (
        ("--uavs", "3", "--from", "papr"),
        SCENARIO,
        "--from: papr: expected a scenario file or the name of a ready one; did you mean 'paper'?",
    ),
    (("--uavs", "3", "--from", "no.toml"), SCENARIO, "--from: no.toml: no such file"),
    (
        ("--uavs", "3", "--from", "there.toml"),
        SCENARIO,
        "--from: there.toml: name: expected a value, got nothing",
    ),
    (
        ("--uavs", "3", "--from", "wide.toml"),
        SCENARIO,
        "--from: wide.toml: controller.separation.minimum_m: expected at most 0.500 m "
        "(UAV1 and UAV2 at hover), got 0.6",
    ),
    (
        ("--uavs", "3", "--from", "unequal.toml"),
        SCENARIO,
        "unequal.toml: system.uav.2.mass_kg: expected 1.6, as of UAV1, or a vehicle for the new team, got",
    ),
    (
        ("--uavs", "3", "--from", "fourth.toml"),
        SCENARIO,
        "fourth.toml: controller.constraint: constraint 'thrust4 <= 40': unknown name 'thrust4'; known: ",
    ),
]


@pytest.fixture(name="folder")
def folder_with_templates(tmp_path: Path) -> Path:
    """Return a folder with an empty file and templates of which no ring of three can be made."""
    paper = PAPER.read_text(encoding="utf-8")
    (tmp_path / "there.toml").touch()
    (tmp_path / "mine.toml").write_text(MINE, encoding="utf-8")
    wide = (
        paper.replace("minimum_m = 0.4", "minimum_m = 0.6")
        .replace("[0.25, ", "[0.5, ")
        .replace("[-0.25, ", "[-0.5, ")
    )
    (tmp_path / "wide.toml").write_text(wide, encoding="utf-8")
    unequal = paper.replace("mass_kg = 1.5", "mass_kg = 1.6", 1)
    (tmp_path / "unequal.toml").write_text(unequal, encoding="utf-8")
    (tmp_path / "fourth.toml").write_text(
        paper + '\n[[controller.constraint]]\nexpression = "thrust4 <= 40"\n', encoding="utf-8"
    )
    return tmp_path


@pytest.mark.parametrize(
    ("options", "code", "text"), REFUSED, ids=[" ".join(options) for options, _, _ in REFUSED]
)
def test_refusals(
    options: tuple[str, ...], code: int, text: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A refusal is one line with the documented exit code; no file is written or changed."""
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    monkeypatch.chdir(folder)
    result = here(*NEW, *options)
    assert (result.exit_code, result.stdout) == (code, "")
    assert result.stderr.startswith(f"transport: {text}")
    assert len(result.stderr.strip().splitlines()) == 1
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_a_file_and_standard_output_are_the_same(tmp_path: Path) -> None:
    """The text is the same with and without --out, and the file gives the team of the options."""
    options = ("--uavs", "5", "--from", "paper", "--groups", "2", "--name", "five")
    path = tmp_path / "five.toml"
    printed, written = here(*NEW, *options), here(*NEW, *options, "--out", path)
    assert (printed.exit_code, printed.stderr) == (0, "")
    assert (written.exit_code, written.stdout) == (0, "")
    assert path.read_text(encoding="utf-8") == printed.stdout
    expected = resized(read_scenario(PAPER), Team(uavs=5, group=2, name="five"), "")
    assert read_scenario(path) == expected
    assert tomllib.loads(printed.stdout) == given_values(expected)  # without defaults
    assert Setup.of(read_scenario(path), str(path)).owned == ((0, 1), (2, 3), (4,))


def test_resilient_is_the_default(tmp_path: Path) -> None:
    """Without --from a team has the settings of `resilient`, which are valid for other team sizes."""
    text = here(*NEW, "--uavs", "6").stdout
    (tmp_path / "six.toml").write_text(text, encoding="utf-8")
    scenario = read_scenario(tmp_path / "six.toml")
    assert scenario.name == "resilient-6"
    assert scenario.controller == read_scenario(SCENARIOS / "resilient.toml").controller


def test_a_load_wider_than_the_ring_is_told(tmp_path: Path) -> None:
    """A line has the payload's radius of gyration sqrt(J_z / m) if it is larger than the ring of attachments."""
    path = tmp_path / "two.toml"
    made = here(*NEW, "--uavs", "2", "--load", "4", "--out", str(path))
    setup = Setup.of(read_scenario(path), str(path))
    gyration_m = float(setup.system.payload.inertia[2, 2] / 4.0) ** 0.5
    ring_m = float(np.linalg.norm(setup.system.uavs[0].rho[:2]))
    assert gyration_m > ring_m
    line = f"payload: radius of gyration {gyration_m:.2f} m, larger than the ring of attachments, {ring_m:.2f} m"
    assert line in made.stderr

    compact = f"system.payload.inertia_kgm2={[4.0 * (0.9 * ring_m) ** 2] * 3}"
    setup = Setup.of(read_scenario(path, [compact]), "two.toml")
    assert wide_load(setup) == ""
