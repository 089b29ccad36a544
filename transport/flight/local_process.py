"""State of a process that a run on this machine has started, from Linux's /proc."""

from contextlib import suppress
from itertools import pairwise
from pathlib import Path

from transport.flight.live import LiveRun
from transport.flight.vitals import has_died, is_stopped


def why_silent(folder: Path, run: LiveRun, name: str) -> str:
    """Return why a process of an active run cannot answer, and the remedy: it has ended, or is stopped.

    Empty if it runs, was not started by the run, or the system does not tell.

    Args:
        folder: Run folder; the processes that the run has started write their output below it.
        run: The active run of that folder.
        name: Process name.
    """
    if not (folder / "logs" / f"{name}.log").exists():
        return ""
    children = _children(run.pid)
    if children is None:
        return ""
    role = ("--id", name.removeprefix("agent")) if name.startswith("agent") else ("transport", name)
    pid = next((pid for pid in children if {role, ("--run", run.run)} <= _pairs(pid) and not has_died(pid)), None)
    is_agent = name.startswith("agent")
    if pid is None:
        remedy = f"; transport fault restart {name} starts it again" if is_agent else ", and the run ends"
        return f"{name} of run {run.run} has ended{remedy}"
    if is_stopped(pid):
        remedy = f"; transport fault continue {name} lets it go on" if is_agent else ""
        return f"{name} of run {run.run} is stopped by a signal{remedy}"
    return ""


def _children(parent: int) -> list[int] | None:
    """Return the process ids of the children of a process, or None if the system does not tell."""
    try:
        threads = list(Path(f"/proc/{parent}/task").iterdir())
        return [int(pid) for thread in threads for pid in (thread / "children").read_text().split()]
    except OSError:
        return None


def _pairs(pid: int) -> set[tuple[str, str]]:
    """Return the neighbouring words in the command line of a process; none if it is gone."""
    with suppress(OSError):
        line = Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
        return set(pairwise(line.split()))
    return set()
