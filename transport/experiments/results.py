"""What an experiment's folder keeps: which experiment it is, and one line for each flight that is done."""

import fcntl
import os
from dataclasses import asdict
from pathlib import Path
from types import TracebackType

import orjson

from transport.experiments.errors import ExperimentError, refused
from transport.experiments.flight import ERROR, NUMBERS, Result
from transport.report.report import write_whole

_IDENTITY, _RESULTS = "experiment.json", "results.jsonl"


class Results:
    """The finished flights of an experiment, on disk as soon as they are known.

    Args:
        folder: Of the experiment; created unless it is there.
        experiment: Its name.
        machine: Where it was begun, for people.
    Raises: ExperimentError: the folder is of something else, in use, or cannot be written.
    """

    def __init__(self, folder: Path, experiment: str, machine: str) -> None:
        self.notices: list[str] = []
        self._by_key: dict[str, Result] = {}
        try:
            _claim(folder, experiment, machine)
            self._file = os.open(folder / _RESULTS, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
        except OSError as error:
            raise ExperimentError(f"--out: cannot write {folder} ({error.strerror})") from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._file)
            raise refused("--out", "an experiment that nobody else is at", f"{folder}, which is in use") from error
        self._read(folder / _RESULTS)

    def __enter__(self) -> "Results":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self._file)

    def __getitem__(self, key: str) -> Result:
        """What came of a flight that was flown."""
        return self._by_key[key]

    def done(self, key: str) -> bool:
        """Whether a flight need not be flown again."""
        return key in self._by_key and self._by_key[key].outcome != ERROR

    def add(self, result: Result) -> None:
        """Keep a result: it survives whatever ends this process from here on."""
        os.write(self._file, orjson.dumps(asdict(result)) + b"\n")
        os.fsync(self._file)
        self._by_key[result.key] = result

    def _read(self, path: Path) -> None:
        content = path.read_bytes()
        whole = content.rfind(b"\n") + 1
        if whole < len(content):
            os.ftruncate(self._file, whole)  # or the next line would become part of it
            self.notices.append(f"{path}: the last line is not whole; its flight is flown again")
        for number, line in enumerate(content[:whole].splitlines(), start=1):
            try:
                result = Result(**orjson.loads(line))
            except (ValueError, TypeError):
                self.notices.append(f"{path}: line {number} is no result; its flight is flown again")
                continue
            missing = [name for name in NUMBERS if name not in result.numbers]
            if missing and result.outcome != ERROR:
                self.notices.append(f"{path}: line {number} has no {missing[0]}; its flight is flown again")
                continue
            self._by_key[result.key] = result


def _claim(folder: Path, experiment: str, machine: str) -> None:
    """Make the folder this experiment's, unless it is already."""
    identity = folder / _IDENTITY
    expected = f"a folder that does not exist yet, or one of experiment {experiment}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise refused("--out", expected, f"{folder}, which is a file") from error
    if identity.exists():
        try:
            found = orjson.loads(identity.read_bytes())["experiment"]
        except (ValueError, TypeError, KeyError) as error:
            raise refused("--out", expected, f"{folder}, whose {_IDENTITY} cannot be read") from error
        if found != experiment:
            raise refused("--out", expected, f"{folder}, which is one of {found}")
        return
    # What a kill can leave of the first moments does not count.
    if any(path.name != f"{_IDENTITY}.partial" for path in folder.iterdir()):
        raise refused("--out", expected, f"{folder}, which holds something else")
    content = {"experiment": experiment, "machine": machine}
    write_whole(identity, orjson.dumps(content, option=orjson.OPT_INDENT_2) + b"\n")
