"""Campaign of hostile messages: `python -m tests.campaigns.wire --messages N --seed S`.

Intruders send bad messages of every sort to all processes of runs: open ones, with and without
their recorder, and some with certificates, where the intruder has those of agent 1. A run has to
end with the bits of one without intruder, and its processes have to count refusals. Sessions
without secret or certificate must not connect. Exit code 1 otherwise.
"""

import argparse
import json
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from tests.support import attacker
from tests.support.attacker import bombard, intruding, proofs_of_connection, table
from tests.support.commands import free_base, settings, start, wait_for
from tests.support.garbage import Garbage
from tests.support.keyrings import keyring
from tests.support.logs import record_run
from tests.support.runs import ready
from transport.protocol.network.mesh import process_names
from transport.protocol.wire.key_expressions import RECORDER, Keys
from transport.report.report import write_report

# The last messages are sent well before the end, so that they arrive during the run, also on a busy
# machine.
_TICKS, _UNTIL = 800, 0.75
# Messages of three ticks: older ones have reached all processes.
_DELAY = 60
# Time for one run on a busy machine, and for a session that must not connect, s.
_RUN_S, _REFUSED_S = 600.0, 0.7
_ACCESS = ("open", "recorder", "secret", "certificates")


@dataclass(slots=True)
class Result:
    """Result of the runs with one kind of access.

    Their number, messages sent by sort, refusals by process.
    """

    runs: int = 0
    sent: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    findings: list[str] = field(default_factory=list)


def campaign(access: str, messages: int, seed: int, folder: Path, *, ticks: int = _TICKS) -> Result:
    """Attack runs with one kind of access until so many messages are sent.

    Where none connects, one run.
    """
    result = Result()
    while result.sent.total() < messages:
        before = result.sent.total()
        rng = np.random.default_rng((seed, result.runs))
        _attack(access, messages - before, rng, folder, result, ticks)
        sys.stderr.write(f"{access}: run {result.runs}, {result.sent.total()} messages sent\n")
        if result.sent.total() == before:
            break
    return result


def _attack(
    access: str, messages: int, rng: np.random.Generator, folder: Path, result: Result, ticks: int
) -> None:
    """Attack one run; it is paced to real time at the most, so that intruders have time."""
    name, base = f"{access}-{result.runs}", free_base()
    climb = (
        f"maneuver.phase=[{{name='climb',duration_s={0.05 * ticks},displacement_m=[0.0,0.0,-1.0]}}]"
    )
    flight = (climb, "controller.horizon=5", "clock.speed=1.0")
    network = {"secret": (), "certificates": (f"network.keys={keyring('one')}",)}.get(
        access, ("network.secret=false",)
    )
    run, keys = ready("paper", *flight), Keys(name)
    names = [*process_names(run.scenario), *([] if access == "open" else [RECORDER])]
    command = [
        "run",
        "paper",
        *settings(*flight, f"network.base_port={base}", *network),
        "--out",
        name,
        "--no-figures",
    ]
    process = start(*command, "--format", "json", cwd=folder)
    result.runs += 1
    try:
        wait_for(lambda: (folder / name / "live.json").exists() or process.poll() is not None)
        found = json.loads((folder / name / "live.json").read_bytes())["endpoints"]
        endpoints = [found[each] for each in names]
        for secure in _strangers(access):
            with suppress(zenoh.ZError), attacker.session(endpoints[:1], secure, _REFUSED_S):
                result.findings.append(f"{name}: a session without keys has connected")
        if access != "secret":
            source = Garbage("recorder", keys, rng, delay=_DELAY)
            secure, awaited, hears = None, proofs_of_connection(keys, run.agents), list[str]()
            if access == "certificates":  # the session hears what agent 1 may hear
                secure, awaited = attacker.tls(keyring("one"), "agent1"), {f"{keys.prefix}/instant"}
                hears = keys.subscriptions("agent1")
            with intruding(keys, endpoints, secure, hears) as mesh:
                until = round(_UNTIL * ticks)
                result.sent.update(
                    bombard(mesh, source, process, awaited, shots=messages, until_tick=until)
                )
                if process.poll() is not None:
                    result.findings.append(f"{name}: the run ended before the attack")
                # The end of the session would drop messages.
                wait_for(lambda: process.poll() is not None, _RUN_S)
        printed, errors = process.communicate(timeout=_RUN_S)
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
            process.communicate(timeout=_RUN_S)
    if process.returncode != 0:
        result.findings.append(
            f"{name}: exit code {process.returncode}: {errors.strip().splitlines()[-1:]}"
        )
        return
    for entry in json.loads(printed)["rejections"]:
        result.refused[entry["by"]] += entry["count"]
    if table(folder / name) != _calm(folder, flight):
        result.findings.append(f"{name}: the steps differ from those of a run without intruder")


def _strangers(access: str) -> Iterator[dict[str, Any] | None]:
    """Yield Zenoh's sections `transport` of sessions without the right keys."""
    if access == "secret":
        yield None
        for user in ("run", "root"):
            yield {"auth": {"usrpwd": {"user": user, "password": "0" * 48}}}
    elif access == "certificates":
        yield attacker.tls(None, "", keyring("one") / "ca.pem")
        yield attacker.tls(keyring("other"), "agent1", keyring("one") / "ca.pem")


def _calm(folder: Path, flight: Sequence[str]) -> list[dict[str, str]]:
    """Return the steps of the same run in memory; they do not depend on how messages travel."""
    calm = folder / "calm"
    if not calm.exists():
        record_run(ready("paper", *flight), calm)
        write_report(calm, figures=False)
    return table(calm)


def main() -> int:
    """Run the campaign with the options of the command line; return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.campaigns.wire", description=__doc__)
    parser.add_argument(
        "--messages", type=int, default=1_000_000, help="messages in all, half of them to open runs"
    )
    parser.add_argument("--seed", type=int, default=0, help="random seed of the messages")
    parser.add_argument(
        "--access", choices=_ACCESS, action="append", help="kinds of access; all by default"
    )
    options = parser.parse_args()
    chosen = options.access or _ACCESS
    each = options.messages // len([access for access in chosen if access != "secret"] or [1])
    lines, findings = [], []
    with tempfile.TemporaryDirectory(prefix="wire-") as folder:
        for access in chosen:
            result = campaign(access, each, options.seed, Path(folder))
            sent, refused = result.sent.total(), result.refused.total()
            lines.append(
                f"{access:<14}{result.runs:>4} runs {sent:>10} messages sent {refused:>10} refused"
            )
            findings += result.findings
    lines += findings or ["all runs equal bit for bit to one without intruder"]
    sys.stdout.write("\n".join(lines) + "\n")
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
