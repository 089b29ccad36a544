"""The process that reports a run: the same files as any report, prepared or not, and nothing left behind."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.support import runs
from tests.support.commands import command_of, wait_for
from tests.support.logs import record_run
from transport.cli.run import ReportProcess
from transport.report.report import write_report

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")

# Time in which a process prepares on a busy machine, s; the test holds for any.
_PREPARING_S = 3.0


def files(folder: Path) -> dict[str, bytes]:
    """Return the files of a report by name."""
    return {path.name: path.read_bytes() for path in [*folder.glob("s*.*"), *folder.glob("figures/*")]}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, bytes]]:
    """Return a run folder and the files of its report by this process."""
    folder = tmp_path_factory.mktemp("run")
    record_run(runs.setup(runs.SHORT), folder)
    write_report(folder)
    return folder, files(folder)


@pytest.mark.slow
@pytest.mark.parametrize("waiting_s", [0.0, _PREPARING_S], ids=["at-once", "prepared"])
def test_equal_reports(recorded: tuple[Path, dict[str, bytes]], waiting_s: float) -> None:
    """The process writes the bytes that a report in one process writes, prepared or not."""
    folder, expected = recorded
    assert len(expected) == 11
    for path in folder.glob("figures/*"):
        path.unlink()
    with ReportProcess(folder) as reporter:
        reporter.prepare()
        time.sleep(waiting_s)
        assert reporter.report()
    assert files(folder) == expected


@pytest.mark.slow
def test_ends_with_its_parent(tmp_path: Path) -> None:
    """A process that stands by ends when its parent is killed."""
    code = (
        "import time\nfrom pathlib import Path\nfrom transport.cli.run import ReportProcess\n"
        "reporter = ReportProcess(Path('/none'))\nreporter.prepare()\nprint(reporter._child.process.pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, cwd=tmp_path, text=True) as process:
        assert process.stdout is not None
        number = process.stdout.readline().strip()
        assert wait_for(lambda: command_of(number) == ["transport", "plot", "/none"])
        process.kill()
    assert wait_for(lambda: command_of(number) == [])
