"""The process that reports a run: the same files as any report, and nothing left behind."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.support import runs
from tests.support.commands import command_of, wait_for
from tests.support.logs import record_run
from transport.cli.report_process import ReportProcess
from transport.report.report import write_report

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="processes are forked on Linux alone"
)


def files(folder: Path) -> dict[str, bytes]:
    """Return the files of a report by name."""
    return {
        path.name: path.read_bytes() for path in [*folder.glob("s*.*"), *folder.glob("figures/*")]
    }


@pytest.mark.slow
def test_equal_reports(tmp_path: Path) -> None:
    """The process, asked while it prepares, writes the bytes that a report in one process writes."""
    record_run(runs.setup(runs.SHORT), tmp_path)
    write_report(tmp_path)
    expected = files(tmp_path)
    assert len(expected) == 7
    for path in tmp_path.glob("figures/*"):
        path.unlink()
    with ReportProcess(tmp_path) as reporter:
        reporter.prepare()
        reporter.begin()
        assert reporter.report()
    assert files(tmp_path) == expected


@pytest.mark.slow
def test_ends_with_its_parent(tmp_path: Path) -> None:
    """A process that stands by ends when its parent is killed."""
    record_run(runs.setup(runs.SHORT), tmp_path)  # without a run it would end by itself
    code = (
        "import time\nfrom pathlib import Path\nfrom transport.cli.report_process import ReportProcess\n"
        "reporter = ReportProcess(Path())\nreporter.prepare()\nprint(reporter._child.process.pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, cwd=tmp_path, text=True
    ) as process:
        assert process.stdout is not None
        number = process.stdout.readline().strip()
        # A title by fork, or a program of its own where the fork server has not answered in time.
        assert wait_for(lambda: str(tmp_path) in command_of(number))
        time.sleep(1.0)  # one that does not stand by has ended by then
        assert str(tmp_path) in command_of(number)
        process.kill()
    assert wait_for(lambda: command_of(number) == [])
