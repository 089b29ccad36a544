"""Files are whole or not there, whatever ends their writing."""

from pathlib import Path

import pytest

from tests.support.full_disk import files_of_at_most
from transport.protocol.scenario.files.atomic_writing import (
    Lines,
    UnwrittenError,
    write_csv,
    write_whole,
)
from transport.protocol.wire.errors_and_exit_codes import EXIT_UNRECORDED, TransportError

LIMIT = 1000  # bytes
ROWS = [{"number": number} for number in range(LIMIT)]


@pytest.mark.parametrize("kind", ["bytes", "text", "table"])
def test_a_file_on_a_full_disk_stays_as_it_was(kind: str, tmp_path: Path) -> None:
    """The error is one that names the file and the reason; nothing else is left."""
    file = tmp_path / "kept"

    def write() -> None:
        if kind == "table":
            write_csv(file, ROWS, ["number"])
        else:
            write_whole(file, b"x" * (LIMIT + 1) if kind == "bytes" else "ä" * LIMIT)

    for before in (None, b"before"):
        if before is not None:
            file.write_bytes(before)
        with (
            files_of_at_most(LIMIT),
            pytest.raises(UnwrittenError, match="cannot write ") as caught,
        ):
            write()
        assert isinstance(caught.value, TransportError)
        assert isinstance(caught.value, OSError)
        assert str(caught.value) == f"cannot write {file} (File too large)"
        assert caught.value.exit_code == EXIT_UNRECORDED
        assert [one.name for one in tmp_path.iterdir()] == ([] if before is None else ["kept"])
    assert file.read_bytes() == b"before"

    write()
    assert len(file.read_bytes()) > LIMIT


def test_another_error_leaves_nothing(tmp_path: Path) -> None:
    """An error of the content passes as it is."""
    with pytest.raises(ValueError, match="dict contains fields not in fieldnames"):
        write_csv(tmp_path / "table", ROWS, ["other"])
    assert list(tmp_path.iterdir()) == []


def test_lines_on_a_full_disk_are_whole(tmp_path: Path) -> None:
    """The line that did not fit is not there in part, and lines are added again once there is room."""
    file = tmp_path / "lines"
    line = b"0123456789" * 30
    lines = Lines(file)
    assert lines.read() == []
    with files_of_at_most(LIMIT):
        for _ in range(3):
            lines.add(line)
        with pytest.raises(UnwrittenError, match=r"cannot write .*lines"):
            lines.add(line)
    assert file.read_bytes().splitlines() == [line] * 3
    lines.add(b"room")
    assert lines.read() == [line] * 3 + [b"room"]
    lines.close()


def test_a_line_that_a_kill_has_cut_takes_no_other_with_it(tmp_path: Path) -> None:
    """The next line does not continue it."""
    file = tmp_path / "lines"
    file.write_bytes(b"one\ntw")
    lines = Lines(file)
    assert lines.read() == [b"one", b"tw"]
    lines.add(b"three")
    lines.close()
    assert file.read_bytes() == b"one\ntw\nthree\n"
