"""Values of options that no run can use are refused before anything starts, by name."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from transport.cli.main import app


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["view", "none", "--host", ""], "--host: expected an address"),
        (["run", "paper", "--view", "--host", " "], "--host: expected an address"),
        (["agent", "--id", "1", "--join-timeout", "inf"], "--join-timeout: expected 0 to 1e+06 s"),
        (
            ["agent", "--id", "1", "--join-timeout", "nan"],
            "'--join-timeout': expected greater than or equal to 0, got 'nan'",
        ),
    ],
)
def test_a_value_that_cannot_be_used_is_refused(
    arguments: list[str], problem: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An empty address, which would listen on all, and an endless timeout end the command with code 2."""
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    assert problem in result.stderr
    assert list(tmp_path.iterdir()) == []
