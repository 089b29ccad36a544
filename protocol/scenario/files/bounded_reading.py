"""Bounded reading: no file, device or compressed record takes more memory than its kind needs."""

from pathlib import Path

MB = 1_000_000

# Largest size of each kind of file or record, bytes.
MOST_TEXT = 10 * MB  # scenarios, vehicles, tables: some 100,000 rows
MOST_RECORD = 64 * MB  # of a log, compressed or not; those written have 0.13 MB, or one message

_BYTE_ORDER_MARK = "\ufeff"  # spreadsheets and editors of Windows write it in front


class TooLargeError(ValueError):
    """A file or record beyond the size of its kind; the text has expected and got."""


def read_bytes(path: Path, most: int) -> bytes:
    """Return the content of a file of a limited size.

    The limit holds for what is read, not for the size of the file: devices and pipes have none.

    Raises: OSError: it cannot be read. TooLargeError: it is larger.
    """
    with path.open("rb") as file:
        content = file.read(most + 1)
    check_size(len(content), most)
    return content


def read_text(path: Path, most: int = MOST_TEXT) -> str:
    """Return the text of a UTF-8 file of a limited size, without a byte order mark.

    Raises: OSError: it cannot be read. UnicodeDecodeError: it is no such text. TooLargeError: it is
        larger.
    """
    return read_bytes(path, most).decode("utf-8").removeprefix(_BYTE_ORDER_MARK)


def check_size(size: int, most: int) -> None:
    """Raise TooLargeError for a size beyond a limit, bytes."""
    if size > most:
        raise TooLargeError(f"expected at most {most / MB:,g} MB, got more")
