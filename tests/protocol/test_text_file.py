"""Files that a scenario names: regular, readable, of bounded size; anything else is refused, and nothing waits."""

import os
from pathlib import Path

import pytest

from protocol.scenario import files
from protocol.scenario.file import ScenarioError, find_scenario, read_scenario
from protocol.scenario.files import read_text
from protocol.scenario.setup import Setup


def refusal(folder: Path, name: str) -> str:
    """Return the errors of a scenario whose maneuver, or else whose links, name a file."""
    path = folder / "scenario.toml"
    path.write_bytes(find_scenario("paper").read_bytes())
    texts = []
    for setting in (
        f"maneuver.phase.1={{name='way',file='{name}'}}",
        f"links={{distribution='empirical',samples='{name}'}}",
    ):
        with pytest.raises(ScenarioError) as caught:
            Setup.of(read_scenario(path, [setting]), str(path))
        texts.append(str(caught.value))
    assert all("\n" not in text for text in texts)
    return "; ".join(texts)


def test_devices_and_pipes_are_refused(tmp_path: Path) -> None:
    """A device without end and a pipe without a writer are refused at once."""
    os.mkfifo(tmp_path / "pipe")
    for name in ("/dev/zero", str(tmp_path / "pipe")):
        assert refusal(tmp_path, name).count("expected a regular file") == 2


def test_size_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file of the largest size is read, a larger one refused; so is a scenario, and an endless one."""
    monkeypatch.setattr(files, "MOST_BYTES", 1000)
    (tmp_path / "most").write_bytes(b"x" * 1000)
    (tmp_path / "more").write_bytes(b"x" * 1001)
    assert read_text(tmp_path / "most") == "x" * 1000
    with pytest.raises(OSError, match="at most 1,000 bytes"):
        read_text(tmp_path / "more")
    with pytest.raises(ScenarioError, match="at most 1,000 bytes"):
        read_scenario(Path("/dev/zero"))


@pytest.mark.parametrize("text", ["a = " + "[" * 5000, "a = " + "{b=" * 5000, "a = 1" + "0" * 5000])
def test_toml_that_the_parser_gives_up_on(text: str, tmp_path: Path) -> None:
    """Deep nesting and integers of thousands of digits are refused as invalid TOML, in files and settings."""
    path = tmp_path / "deep.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ScenarioError, match="not valid TOML"):
        read_scenario(path)
    with pytest.raises(ScenarioError):
        read_scenario(find_scenario("paper"), [f"seed{text[1:]}"])
