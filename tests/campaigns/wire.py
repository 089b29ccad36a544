"""Campaign of hostile messages: `python -m tests.campaigns.wire --messages N --seed S`.

Intruders send bad messages of every sort to all processes of runs: open ones with and without their recorder, one with
its secret, some with certificates. A run has to end with the bits of one without intruder, and every process has to
count every message that it received as refused. Where there is a secret or certificates, sessions without them must not
connect, and a session with the certificate of one agent may send under that name only. Exit code 1 if a run differs,
a process has accepted a message, or a session without keys connects.
"""

import argparse
import json
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from protocol.network.endpoints import process_names
from protocol.network.session import fetch_answer
from protocol.wire.keys import RECORDER, Keys, matches
from tests.support import attacker
from tests.support.attacker import Deliveries, Mesh, bombard, intruding, proofs_of_connection, table
from tests.support.commands import free_base, settings, start, wait_for
from tests.support.garbage import Garbage
from tests.support.keyrings import keyring
from tests.support.logs import record_run
from tests.support.runs import ready
from transport.report.report import write_report

_TICKS = 800
# The last messages are sent well before the end, so that all of them arrive during the run, also on a busy machine.
_QUIET = 0.25
# Messages at a time, and time between, s: below the rate at which receivers slow a sender down for good.
_BURST, _PAUSE_S = 200, 0.01
# Messages of three ticks: older ones have reached all processes.
_DELAY = 60
# Time for one run on a busy machine, for a session that must not connect, and for the health of a process, s.
_RUN_S, _REFUSED_S, _HEALTH_S = 600.0, 0.7, 5.0

# Open runs whose recorder is spared, and others where it is attacked as well; at a high load of the host a flood
# of it costs parts of the record.
_ACCESS = ("open", "recorder", "secret", "certificates")


@dataclass(slots=True)
class Result:
    """Result of the runs with one kind of access.

    Attributes:
        runs: Number of runs.
        sent: Number of messages by sort.
        received: Messages that reached processes, each counted once for every process it reached.
        refused: Messages that processes counted as refused, each process for itself.
        tried, connected: Sessions without keys that tried to connect, and that did.
        findings: Descriptions of what must not happen.
    """

    runs: int = 0
    sent: Counter[str] = field(default_factory=Counter)
    received: int = 0
    refused: int = 0
    tried: int = 0
    connected: int = 0
    findings: list[str] = field(default_factory=list)


def _flight(ticks: int) -> tuple[str, ...]:
    """Return settings of a run, paced to real time at the most, so that intruders have time; a flood slows it down."""
    climb = f"maneuver.phase=[{{name='climb',duration_s={0.05 * ticks},displacement_m=[0.0,0.0,-1.0]}}]"
    return climb, "controller.horizon=5", "clock.speed=1.0"


def campaign(access: str, messages: int, seed: int, folder: Path, *, ticks: int = _TICKS) -> Result:
    """Attack runs with one kind of access until so many messages are sent; where none connects, one run."""
    result = Result()
    while result.sent.total() < messages:
        before = result.sent.total()
        rng = np.random.default_rng((seed, result.runs))
        _attack(access, messages - before, rng, folder, result, ticks)
        sys.stderr.write(f"{access}: run {result.runs}, {result.sent.total()} messages sent\n")
        if result.sent.total() == before:
            break
    return result


def _attack(access: str, messages: int, rng: np.random.Generator, folder: Path, result: Result, ticks: int) -> None:
    name, base = f"{access}-{result.runs}", free_base()
    result.runs += 1
    flight = _flight(ticks)
    network = {
        "open": ("network.secret=false",),
        "recorder": ("network.secret=false",),
        "secret": (),
        "certificates": (f"network.keys={keyring('one')}",),
    }[access]
    run = ready("paper", *flight)
    keys, names, relayed = Keys(name), process_names(run.scenario), True
    names = [*names, *([] if access == "open" else [RECORDER])]
    command = ["run", "paper", *settings(*flight, f"network.base_port={base}", *network), "--out", name, "--no-figures"]
    process = start(*command, "--format", "json", cwd=folder)
    try:
        wait_for(lambda: (folder / name / "live.json").exists() or process.poll() is not None)
        endpoints = list(_endpoints(folder / name, names))
        for secure in _strangers(access) if endpoints else ():
            result.tried += 1
            with suppress(zenoh.ZError), attacker.session(endpoints[:1], secure, _REFUSED_S):
                result.connected += 1
                result.findings.append(f"{name}: a session without keys has connected")
        if access != "secret" and endpoints:
            secure = attacker.tls(keyring("one"), "agent1") if access == "certificates" else None
            max_bytes = run.shape.max_bytes
            source = Garbage("recorder", keys, run, max_bytes, rng, incarnation=0, delay=_DELAY, far=ticks)
            awaited, hears = proofs_of_connection(keys, run.agents, relayed=relayed), list[str]()
            may_send = None
            if access == "certificates":  # the session hears what agent 1 may hear
                awaited = {f"{keys.prefix}/measurement/1"}
                hears, may_send = keys.subscriptions("agent1", relayed=relayed), keys.publications("agent1")
            delivered = Deliveries(keys, names, relayed=relayed, may_send=may_send)
            with intruding(keys, endpoints, secure, hears) as mesh:
                before = _refused_before(mesh, keys, names, process, relayed=relayed, may_send=may_send)
                shots = bombard(
                    mesh,
                    source,
                    process,
                    awaited,
                    shots=messages,
                    until_tick=round((1.0 - _QUIET) * ticks),
                    burst=_BURST,
                    pause_s=_PAUSE_S,
                    timeout_s=_RUN_S,
                )
                for sort, key, data in shots:
                    result.sent[sort] += 1
                    delivered.add(key, data)
                is_connected = process.poll() is None
                # The end of the session would drop what a slowed-down process has not read.
                _settled(mesh, keys, names, process)
        printed, errors = process.communicate(timeout=_RUN_S)
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
            process.communicate(timeout=_RUN_S)
    if process.returncode != 0:
        result.findings.append(f"{name}: exit code {process.returncode}: {errors.strip().splitlines()[-1:]}")
        return
    summary: dict[str, Any] = json.loads(printed)
    result.refused += summary["messages"]["rejected"]
    if access != "secret":
        result.received += delivered.total
        refused = {at: -count for at, count in before.items()}
        for entry in summary["rejections"]:
            refused[entry["by"]] += entry["count"]
        for at, counts in delivered.accepted(refused).items():
            cut = summary["log_cut"] or "the record is whole"
            result.findings.append(f"{name}: {at} counted %d refusals of %d messages and %d bundles; {cut}" % counts)
        if not is_connected:
            result.findings.append(f"{name}: the run ended before the attack")
    if table(folder / name) != _calm(folder, flight):
        result.findings.append(f"{name}: the steps differ from those of a run without intruder")


def _refused_before(
    mesh: Mesh,
    keys: Keys,
    names: Sequence[str],
    process: "subprocess.Popen[str]",
    *,
    relayed: bool,
    may_send: Sequence[str] | None,
) -> dict[str, int]:
    """Prove by bad messages that every process receives those of a session; return the refusals they count for them."""
    every = [key for name in ("coordinator", "plant", "agent1") for key in keys.publications(name)]
    for name in names:
        hears = keys.subscriptions(name, relayed=relayed)
        key = next(key for key in may_send or every if any(matches(expression, key) for expression in hears))

        def has_refused(name: str = name, key: str = key) -> bool:
            mesh.put(key, b"?")
            return (_refused(mesh, keys, name) or 0) > 0

        wait_for(has_refused)
    return {name: count or 0 for name, count in _settled(mesh, keys, names, process).items()}


def _settled(mesh: Mesh, keys: Keys, names: Sequence[str], process: "subprocess.Popen[str]") -> dict[str, int | None]:
    """Return how many messages each process has refused, once all answer and the numbers no longer grow."""
    found: dict[str, int | None] = {name: _refused(mesh, keys, name) for name in names}
    before: dict[str, int | None] = {}
    while process.poll() is None and (found != before or None in found.values()):
        time.sleep(_HEALTH_S / 10.0)
        found, before = {name: _refused(mesh, keys, name) for name in names}, found
    return found


def _refused(mesh: Mesh, keys: Keys, name: str) -> int | None:
    """Return how many messages a process has refused, according to its health; None without an answer in time."""
    health = fetch_answer(mesh.session, keys.request(name, "health"), {}, _HEALTH_S)
    return None if health is None else int(health["refused"])


def _endpoints(folder: Path, names: Sequence[str]) -> Iterator[str]:
    """Yield the endpoints of a run's processes, which `transport status` and `top` use as well."""
    with suppress(OSError):  # the run did not begin
        found = json.loads((folder / "live.json").read_bytes())["endpoints"]
        yield from (found[name] for name in names)


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
    parser.add_argument("--messages", type=int, default=1_000_000, help="messages in all, half of them to open runs")
    parser.add_argument("--seed", type=int, default=0, help="random seed of the messages")
    parser.add_argument("--access", choices=_ACCESS, action="append", help="kinds of access; all by default")
    options = parser.parse_args()
    chosen = options.access or _ACCESS
    each = options.messages // len([access for access in chosen if access != "secret"] or [1])
    with tempfile.TemporaryDirectory(prefix="wire-") as folder:
        results = {access: campaign(access, each, options.seed, Path(folder)) for access in chosen}
    rows: dict[str, list[object]] = {"messages sent": list(results)}
    for sort in sorted({sort for result in results.values() for sort in result.sent}):
        rows[f"  {sort}"] = [result.sent[sort] for result in results.values()]
    rows |= {
        "all": [result.sent.total() for result in results.values()],
        "received by processes": [result.received for result in results.values()],
        "refused by processes": [result.refused for result in results.values()],
        "runs": [result.runs for result in results.values()],
        "sessions without keys": [result.tried for result in results.values()],
        "of them connected": [result.connected for result in results.values()],
    }
    findings = [finding for result in results.values() for finding in result.findings]
    lines = [f"{name:<28}" + "".join(f"{value:>14}" for value in values) for name, values in rows.items()]
    lines += findings or ["all runs equal bit for bit to one without intruder"]
    sys.stdout.write("\n".join(lines) + "\n")
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
