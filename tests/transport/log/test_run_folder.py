"""Folder of a run: its name."""

import time
from datetime import UTC, datetime
from pathlib import Path

import pytest

from transport.log.run_folder import new_folder


def test_a_new_folder_has_the_time_in_utc(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In any time zone; further ones of the same second are counted, and none exists."""
    with monkeypatch.context() as patch:
        patch.setenv("TZ", "XXX-11:30")
        time.tzset()
        before = datetime.now(UTC)
        names = []
        for _ in range(3):
            folder = new_folder(tmp_path, "paper")
            assert folder.parent == tmp_path
            assert not folder.exists()
            folder.mkdir()
            names.append(folder.name)
        after = datetime.now(UTC)
    time.tzset()

    stamps = {at.strftime("%Y%m%d-%H%M%S") for at in (before, after)}
    assert {names[0]} <= {f"{stamp}-paper" for stamp in stamps}
    if len(stamps) == 1:
        assert [name.removeprefix(names[0]) for name in names] == ["", "-2", "-3"]
