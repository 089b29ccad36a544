"""An intruder that sends invalid messages on every key changes neither a run nor its record."""

from pathlib import Path

import pytest

from tests.campaigns.wire import campaign

MESSAGES, FEWEST, TICKS = 2500, 1000, 160


@pytest.mark.slow
def test_an_intruder(tmp_path: Path) -> None:
    """A part of the campaign of hostile messages.

    The steps are those without them, and every process counts some.
    """
    result = campaign("open", MESSAGES, 20240611, tmp_path, ticks=TICKS)
    assert result.findings == []
    assert result.sent.total() >= FEWEST
    assert set(result.refused) >= {"coordinator", "plant", "agent1", "agent2", "agent3", "agent4"}
    assert result.refused.total() > result.sent.total()
