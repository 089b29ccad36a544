"""A case in ns-3: builds and runs reference.cc in a process of its own."""

import subprocess
from collections.abc import Iterator
from pathlib import Path

from benchmarks.radio.cases import Case, end_ns, sends

Arrivals = dict[tuple[int, int], int]


def mode(standard: str, rate_mbps: float) -> str:
    """Return the name of a rate in ns-3."""
    rate = f"{rate_mbps:g}".replace(".", "_")
    return f"DsssRate{rate}Mbps" if standard == "802.11b" else f"OfdmRate{rate}Mbps"


def lines(case: Case, control_mbps: float) -> Iterator[str]:
    """Yield the input of the program."""
    yield f"standard {case.standard}"
    yield f"data_mode {mode(case.standard, case.rate_mbps)}"
    yield f"control_mode {mode(case.standard, control_mbps)}"
    for name in (
        "power_dbm",
        "exponent",
        "reference_loss_db",
        "sensitivity_dbm",
        "preamble_snr_db",
        "carrier_sense_dbm",
    ):
        yield f"{name} {getattr(case, name)}"
    yield f"queue {case.queue_length}"
    yield f"attempts {case.attempts}"
    yield f"seed {case.seed}"
    yield f"end_ns {end_ns(case)}"
    for x, y, z in case.positions:
        yield f"station {x} {y} {z}"
    for send in sends(case):
        yield f"send {send.time_ns} {send.sender} {send.receiver} {case.message_bytes}"


def run(program: Path, case: Case, control_mbps: float) -> Arrivals:
    """Return arrivals by send and receiver, ns, of a case in ns-3; its counts are for people."""
    text = "\n".join(lines(case, control_mbps)) + "\n"
    done = subprocess.run([program], input=text, capture_output=True, text=True, check=True)
    arrivals: Arrivals = {}
    for line in done.stdout.splitlines():
        kind, *values = line.split()
        if kind == "arrival":
            send, receiver, time_ns = map(int, values)
            arrivals.setdefault((send, receiver), time_ns)
    return arrivals
