"""Folders campaign: damages the files of runs while they are written.

In each run one thing happens to the run folder, the disk or a file of the run: it is removed, renamed, replaced, cut,
or full. The run must go on and say so at once; a log that is not lost must open; the exit code must fit, no process may
be left and no output may have a traceback.
"""

import os
import random
import resource
import shutil
import subprocess
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from protocol.network.parent import python
from protocol.wire.exit_codes import EXIT_UNRECORDED, EXIT_USAGE
from protocol.wire.messages import Control
from tests.campaigns.harness import Result
from tests.campaigns.inspection import log_in, remains, wait_for

# Time for a run to begin, and to end, s.
_PATIENCE_S = 90.0
# Bytes of the log when the damage happens, at least and at most, and the space of a disk that becomes full.
_FROM_BYTES, _TO_BYTES = 20_000, 300_000
_DISK = "640k"
_FILE_BYTES = 400_000
_SETTINGS = ("maneuver.phase=[{name='climb',duration_s=12.0,displacement_m=[0,0,-6.0]}]", "clock.speed=6.0")

_CHANGES_OF_STATE: Sequence[bytes] = (
    b"",
    b"{",
    b"\xff\xfe",
    b"[]",
    b"7",
    b"{}",
    b'{"run": "a/b/*", "endpoints": {}, "pid": 1, "keys": "", "is_client": false}',
    b'{"run": "a", "endpoints": {}, "pid": 1, "keys": "", "is_client": false}',
    b'{"run": "a", "endpoints": {"coordinator": 5}, "pid": 1, "keys": "", "is_client": false}',
    b'{"run": "a", "endpoints": {"coordinator": "tcp/127.0.0.1:1"}, "pid": "x", "keys": "", "is_client": false}',
    b'{"run": "a", "endpoints": {"coordinator": "tcp/127.0.0.1:1"}, "pid": -1, "keys": "", "is_client": false}',
    b'{"run": "a", "endpoints": {"coordinator": "tcp/127.0.0.1:1"}, "pid": 1, "keys": [], "is_client": false}',
    b'{"run": "a", "endpoints": {"coordinator": "tcp/127.0.0.1:1"}, "pid": 1, "keys": "", "is_client": 3}',
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Damage:
    """Something that happens to the files of a run.

    Attributes:
        apply: Function that does it to the run folder, given random numbers.
        exit_codes: Exit codes that fit.
        on: "disk" for a small file system, "limit" for a limit of the size of every file.
    """

    apply: Callable[[Path, random.Random], None]
    exit_codes: frozenset[int] = frozenset({0})
    on: str = ""


def _cut(folder: Path, rng: random.Random) -> None:
    log = folder / "run.mcap"
    os.truncate(log, rng.choice((0, rng.randrange(1, log.stat().st_size))))


def _replace(folder: Path, rng: random.Random) -> None:
    new = folder / "new"
    new.write_bytes(rng.randbytes(rng.randrange(2000)))
    new.replace(folder / "run.mcap")


def _rename(folder: Path, _: random.Random) -> None:
    folder.rename(folder.parent / "elsewhere")


def _make_unwritable(folder: Path, _: random.Random) -> None:
    (folder / "summary.json").mkdir()  # stands for a folder that has become read-only, which root could write to


def _change_state(folder: Path, rng: random.Random) -> None:
    """Give live.json other content, ask for the status, and put the content back."""
    state = folder / "live.json"
    before, content = state.read_bytes(), rng.choice(_CHANGES_OF_STATE)
    state.write_bytes(content)
    asked = rng.choice((["status"], ["link", "clear"], ["fault", "stop", "agent1"], ["top", "--once"]))
    result = subprocess.run(
        [*python("transport"), *asked, "--run", folder.name],
        cwd=folder.parent,
        capture_output=True,
        text=True,
        timeout=_PATIENCE_S,
        check=False,
    )
    state.write_bytes(before)
    lines = result.stderr.splitlines()
    if (
        result.returncode != EXIT_USAGE
        or len(lines) != 1
        or "live.json: " not in lines[0]
        or "expected" not in lines[0]
    ):
        raise AssertionError(
            f"live.json with {content!r}: {asked[0]} ended with {result.returncode}, {result.stderr!r}"
        )


def _remove(name: str) -> Callable[[Path, random.Random], None]:
    def apply(folder: Path, _: random.Random) -> None:
        path = folder / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()

    return apply


def _nothing(_folder: Path, _rng: random.Random) -> None:
    """Let the disk fill up."""


_LOST = frozenset({EXIT_UNRECORDED})
DAMAGES: dict[str, Damage] = {
    "log removed": Damage(apply=_remove("run.mcap"), exit_codes=_LOST),
    "log cut": Damage(apply=_cut, exit_codes=_LOST),
    "log replaced": Damage(apply=_replace, exit_codes=_LOST),
    "folder removed": Damage(apply=_remove(""), exit_codes=_LOST),
    "folder renamed": Damage(apply=_rename, exit_codes=_LOST),
    "outputs removed": Damage(apply=_remove("logs")),
    "scenario removed": Damage(apply=_remove("scenario.toml")),
    "report not writable": Damage(apply=_make_unwritable, exit_codes=_LOST),
    "state file changed": Damage(apply=_change_state),
    "disk full": Damage(apply=_nothing, on="disk", exit_codes=_LOST),
    "file size limit": Damage(apply=_nothing, on="limit", exit_codes=_LOST),
}


def execute(seed: int, number: int, folder: Path, stop: threading.Event) -> Result:
    """Execute one run, damage its files in the way of its number, check it, and end all of its processes."""
    names = [name for name, damage in DAMAGES.items() if damage.on != "disk" or can_mount()]
    name, rng = names[number % len(names)], random.Random(f"{seed}/{number}")  # noqa: S311  # no secret
    damage = DAMAGES[name]
    folder.mkdir(parents=True, exist_ok=True)
    run = folder / f"folders-{number}-{os.getpid()}"
    output = folder / "output.txt"
    with output.open("wb") as file:
        command = subprocess.Popen(
            _command(damage, run, folder),
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=file,
            start_new_session=True,
            preexec_fn=_limit_file_size if damage.on == "limit" else None,  # no thread holds a lock
        )
    problems: dict[str, str] = {}

    def is_over() -> bool:
        return command.poll() is not None or stop.is_set()

    try:
        if not damage.on:
            enough, log = rng.randrange(_FROM_BYTES, _TO_BYTES), run / "run.mcap"
            wait_for(lambda: is_over() or (log.exists() and log.stat().st_size > enough), _PATIENCE_S)
            try:
                damage.apply(run, rng)
            except (AssertionError, OSError) as error:
                problems["wrong answer"] = str(error)
        if not wait_for(is_over, _PATIENCE_S):
            problems["hang"] = f"the command has not ended within {_PATIENCE_S:g} s"
    finally:
        if command.poll() is None:
            command.kill()
        command.wait()
    problems |= remains(folder)
    if command.returncode not in damage.exit_codes:
        problems["wrong exit code"] = f"{command.returncode}, expected one of {sorted(damage.exit_codes)}"
    wrong = "; ".join(_problems_of_log(damage, run, output.read_text(errors="replace")))
    if wrong:
        problems["wrong log"] = wrong
    return Result(number=number, label=name, outcome=f"exit {command.returncode}", problems=problems)


def _problems_of_log(damage: Damage, run: Path, said: str) -> Iterator[str]:
    """Yield what is wrong with the log of a run, given what its command has said."""
    if damage.exit_codes == _LOST and damage.apply is not _make_unwritable:
        if "the run continues without recording" not in said:
            yield "the command did not say that the run continues without recording"
        return
    log, unreadable = log_in(run)
    if unreadable or log is None:
        yield f"unreadable log: {unreadable or 'there is none'}"
    elif [control.outcome for control in log.of(Control)] != ["completed"]:
        yield "the log does not say that the run was completed"


def _command(damage: Damage, run: Path, folder: Path) -> list[str]:
    """Return the command of a run; on a small disk it is in a mount namespace, whose disk is the current folder."""
    words = [*python("transport"), "run", "resilient", "--no-figures", "--out", run.name]
    for setting in _SETTINGS:
        words += ["--set", setting]
    if damage.on != "disk":
        return words
    script = f'mkdir -p small && mount -t tmpfs -o size={_DISK} tmpfs small && cd small && "$@"'
    return ["unshare", "--mount", "--map-root-user", "sh", "-c", script, str(folder), *words]


def _limit_file_size() -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (_FILE_BYTES, _FILE_BYTES))


def can_mount() -> bool:
    """Return whether this process may mount a file system in a namespace of its own."""
    words = ["unshare", "--mount", "--map-root-user", "sh", "-c", "mount -t tmpfs tmpfs /mnt"]
    try:
        return subprocess.run(words, capture_output=True, check=False).returncode == 0
    except OSError:
        return False
