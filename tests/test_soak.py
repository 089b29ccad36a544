"""The soak, shorter than it is meant to be, and its judgement."""

import pytest

from benchmarks import soak
from benchmarks.page import BenchmarkError
from benchmarks.soak import GROWTH_BYTES, Record, judge, main

# Besides the flight: its start and its report, and a host that cannot keep up with the clock.
PATIENCE_S = 240


@pytest.mark.slow
@pytest.mark.timeout(60 * 2 + PATIENCE_S)
def test_nothing_grows(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Two minutes in real time, by the limits of thirty: no memory, no thread and no file is lost.

    Whoever is late is waited for: on a host that is busy with other tests the flight would be lost otherwise. And as
    what a host does to others is not the run's, deadlines may be missed more often in one third than in another.
    """
    monkeypatch.setattr(soak, "MISSES", 0.25)
    assert main(["--minutes", "2", "--set", "clock.on_overrun=hold"]) == 0, capsys.readouterr().err
    table = capsys.readouterr().out
    assert all(f"| {name} |" in table for name in ("recorder", "coordinator", "plant", "agent1", "agent4"))


def test_judgement() -> None:
    """What grows is named: memory by more than an allocator wavers, one thread, one file, deadlines."""

    def flat() -> Record:
        return Record(memory=[1e8] * 30, threads=[10.0] * 30, files=[20.0] * 30)

    assert judge({"a": flat()}, [0] * 90)[1] == []
    for change, step, word in (
        ("memory", 3.0 * GROWTH_BYTES, "memory 95.4 -> "),
        ("threads", 3.0, "threads 10 -> 13"),
        ("files", 1.0, "files 20 -> 21"),
    ):
        record = flat()
        values = getattr(record, change)
        values[-10:] = [values[0] + step] * 10
        wrong = judge({"a": record}, [0] * 90)[1]
        assert len(wrong) == 1
        assert word in wrong[0]
    early = flat()
    early.memory[:3] = [1e7] * 3  # the warm-up
    assert judge({"a": early}, [0] * 90)[1] == []
    assert "0 in the first third, 30 in the last" in judge({"a": flat()}, [0] * 60 + [1] * 30)[1][0]
    assert judge({"a": flat()}, [1] * 60 + [0] * 30)[1] == []
    with pytest.raises(BenchmarkError, match="expected at least 4 looks"):
        judge({"a": Record(memory=[1.0], threads=[1.0], files=[1.0])}, [0] * 90)
