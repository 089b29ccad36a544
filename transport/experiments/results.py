"""Results of an experiment, in memory or in a folder: the experiment's name, and one line for each simulated case."""

import fcntl
import os
from dataclasses import asdict
from pathlib import Path
from typing import Self

import orjson

from transport.experiments.errors import ExperimentError, refused
from transport.experiments.simulation import ERROR, NUMBERS, Result
from transport.flight.header import machine
from transport.report.report import write_whole

_IDENTITY, _RESULTS = "experiment.json", "results.jsonl"


class Results:
    """Results by case; with a folder each is written to disk at once, and earlier ones are read from it.

    The folder is created unless it exists; the machine is noted for the reader. Lines of the file that were ignored
    are in `notices`, with the reason.

    Raises: ExperimentError: the folder contains something else, is in use, or cannot be written.
    """

    def __init__(self, experiment: str, folder: Path | None = None) -> None:
        self.folder = folder
        self.notices: list[str] = []
        self._by_key: dict[str, Result] = {}
        self._file: int | None = None
        if folder is None:
            return
        try:
            _identify(folder, experiment)
            self._file = os.open(folder / _RESULTS, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
        except OSError as error:
            raise ExperimentError(f"--out: cannot write {folder} ({error.strerror})") from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._file)
            raise refused("--out", "a folder that no other experiment uses", f"{folder}, which is in use") from error
        self._read(self._file, folder / _RESULTS)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            os.close(self._file)

    def __getitem__(self, key: str) -> Result:
        """Return the result of a simulated case."""
        return self._by_key[key]

    def done(self, key: str) -> bool:
        """Return whether a case has a result other than an error."""
        return key in self._by_key and self._by_key[key].outcome != ERROR

    def add(self, result: Result) -> None:
        """Keep a result; on disk it survives a crash of this process or host."""
        if self._file is not None:
            os.write(self._file, orjson.dumps(asdict(result)) + b"\n")
            os.fsync(self._file)
        self._by_key[result.key] = result

    def _read(self, file: int, path: Path) -> None:
        content = path.read_bytes()
        whole = content.rfind(b"\n") + 1
        if whole < len(content):
            os.ftruncate(file, whole)  # otherwise the next line would be appended to it
            self.notices.append(f"{path}: the last line is incomplete; its case is simulated again")
        for number, line in enumerate(content[:whole].splitlines(), start=1):
            try:
                result = Result(**orjson.loads(line))
                missing = [name for name in NUMBERS if name not in result.numbers and result.outcome != ERROR]
            except (ValueError, TypeError):
                self.notices.append(f"{path}: line {number} is no result; its case is simulated again")
                continue
            if missing:
                self.notices.append(f"{path}: line {number} has no {missing[0]}; its case is simulated again")
            else:
                self._by_key[result.key] = result


def _identify(folder: Path, experiment: str) -> None:
    """Note the experiment in its folder, or check that the folder belongs to it."""
    identity = folder / _IDENTITY
    expected = f"a new folder, or one of experiment {experiment}"
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
            raise refused("--out", expected, f"{folder}, which belongs to {found}")
    # A kill can leave a partial identity file.
    elif any(path.name != f"{_IDENTITY}.partial" for path in folder.iterdir()):
        raise refused("--out", expected, f"{folder}, which contains other files")
    else:
        content = {"experiment": experiment, "machine": machine()}
        write_whole(identity, orjson.dumps(content, option=orjson.OPT_INDENT_2) + b"\n")
