"""Logs in memory of given messages, and run folders of runs that are simulated here."""

from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path

import tomli_w

from transport.flight.memory import simulate
from transport.log.run_log import Recorded, RunLog
from transport.log.writer import LogWriter
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Message

MILLISECOND_NS = 1_000_000

HEADER = {
    "run_id": "r1",
    "processes": "6",
    "seed": "0",
    "versions": "python 3.12.1, numpy 2.0.0",
    "machine": "a machine, 2 cores",
    "command_started_ns": "0",
}


def log_of(messages: Sequence[Message], received_ms: Sequence[float] = ()) -> RunLog:
    """Return a complete log of messages, received 1 ms apart unless `received_ms` is given."""
    times_ms = list(received_ms) or [float(number) for number in range(len(messages))]
    entries = [
        Recorded(message=message, received_ns=round(time_ms * MILLISECOND_NS))
        for message, time_ms in zip(messages, times_ms, strict=True)
    ]
    return RunLog(header=dict(HEADER), messages=tuple(entries), cut="")


def with_scenario(header: Mapping[str, str], run: Setup) -> dict[str, str]:
    """Return the header of a log with the scenario of a run, by which its messages are checked."""
    return {**header, "scenario": tomli_w.dumps(run.scenario.tree())}


def record_run(run: Setup, folder: Path) -> list[Message]:
    """Simulate a run in this process, write its run folder as `transport run` does, and return all messages.

    Messages are received 1 ms apart.
    """
    folder.mkdir(parents=True, exist_ok=True)
    header = with_scenario(HEADER, run)
    (folder / "scenario.toml").write_text(header["scenario"], encoding="utf-8")

    messages: list[Message] = []
    with closing(LogWriter(folder / "run.mcap", header, period_ns=run.period_ns)) as writer:

        def record(message: Message) -> None:
            messages.append(message)
            writer.write(message, len(messages) * MILLISECOND_NS)

        simulate(run, record)
    return messages
