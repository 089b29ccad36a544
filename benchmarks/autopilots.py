"""The team above autopilots, by the same processes as outside: errors, latency of setpoints, processor time.

    python -m benchmarks.autopilots --speed 0.35 --write

flies the ready scenario `flight` once for each row, at a speed that the machine bears, and renews the table of its
autopilot in docs/record/measured.md in a few minutes. Latency is from the arrival of a plan at its vehicle, or its
first instant where that is later, to its first setpoint; jitter is the delay of setpoints after their instants, the
largest within each tick. Both are in scenario time. `--autopilot ardupilot` takes ArduCopter, which ARDUCOPTER names.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from benchmarks.runs import origin
from docs.tables import ROOT, place, put_rows, table
from transport.log.run_log import read_log
from transport.protocol.wire.messages import VehicleStatus

MARKERS = {
    "stand_in": "bench: autopilots stand_in",
    "ardupilot": "bench: autopilots ardupilot",
}
DOCUMENT = ROOT / "docs" / "record" / "measured.md"
LATE = ("links.delay_s=0.2", "links.loss=0.3")
VEHICLE = (
    "faults.event=[{at_s=8.0,do='kill',target='vehicle2'},{at_s=10.0,do='restart',target='vehicle2'}]",
)
AGENT = (
    "faults.event=[{at_s=8.0,do='kill',target='agent2'},{at_s=12.0,do='restart',target='agent2'}]",
)
COORDINATOR = (
    "faults.event=[{at_s=8.0,do='kill',target='coordinator'},{at_s=18.0,do='restart',target='coordinator'}]",
)
CASES: Mapping[str, tuple[str, ...]] = {
    "perfect network": (),
    "200 ms and 30 % loss": LATE,
    "vehicle 2 ends at 8 s, returns at 10 s": VEHICLE,
    "agent 2 ends at 8 s, returns at 12 s": AGENT,
    "coordinator ends at 8 s, returns at 18 s": COORDINATOR,
}
HEADINGS = (
    "case",
    "outcome",
    "payload error, rms",
    "largest attitude",
    "UAVs apart",
    "latency of setpoints: median, p99",
    "jitter: median, p99",
    "processor of a vehicle process at this pace",
)


def row(name: str, settings: tuple[str, ...], autopilot: str, speed: float) -> list[str]:
    """Fly a case and return its row."""
    with tempfile.TemporaryDirectory() as at:
        folder = Path(at) / "run"
        changes = (f"plant.autopilot={autopilot}", f"clock.speed={speed}", *settings)
        options = [text for change in changes for text in ("--set", change)]
        arguments = ["run", "flight", *options, "--no-figures", "--out", str(folder)]
        subprocess.run([sys.executable, "-m", "transport", *arguments], check=False)
        summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
        statuses = [
            status
            for status in read_log(folder / "run.mcap").of(VehicleStatus)
            if status.phase == "flying"
        ]
        shares = [_share(path) for path in sorted(folder.glob("logs/vehicle?.log"))]
    latencies_ms = speed * 1e3 * np.array([s.latency_s for s in statuses if s.latency_s >= 0.0])
    late_ms = speed * 1e3 * np.array([status.late_s for status in statuses])
    return [
        name,
        summary["outcome"],
        f"{100 * summary['payload_tracking']['rms_m']:.1f} cm",
        f"{summary['attitude_max_deg']:.1f} deg",
        f"{summary['separation_min_m']:.2f} m",
        _percentiles(latencies_ms),
        _percentiles(late_ms),
        f"{100 * max(share for share in shares if share):.1f} %",
    ]


def _percentiles(values_ms: np.ndarray) -> str:
    median, most = np.percentile(values_ms, [50, 99])
    return f"{median:.1f} ms, {most:.1f} ms"


def _share(log: Path) -> float:
    """Return the share of a core that a process took from joining to its end; 0 for one that was killed."""
    events = {}
    for line in log.read_text(encoding="utf-8").splitlines():
        entry = json.loads(line)
        events[entry["event"]] = entry
    if "finished" not in events:
        return 0.0
    cpu_s = float(events["finished"]["cpu_s"]) - float(events["listening"]["cpu_s"])
    wall_s = float(events["finished"]["time"]) - float(events["joined"]["time"])
    return cpu_s / wall_s


def main() -> None:
    """Fly the cases and print their table."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.autopilots", description="Measure the team above autopilots."
    )
    parser.add_argument("--speed", type=float, default=1.0, help="scenario seconds per second")
    parser.add_argument("--autopilot", default="stand_in", choices=MARKERS)
    parser.add_argument("--row", action="append", choices=CASES, help="these rows alone")
    parser.add_argument("--write", action="store_true", help="renew rows of the page")
    options = parser.parse_args()
    marker = MARKERS[options.autopilot]
    if options.write:
        place(DOCUMENT, marker)  # refused before minutes are spent
    how = f"{options.autopilot}, {options.speed:g} of real time; one run each. {origin()}"
    rows = {}
    for name in options.row or CASES:
        rows[name] = row(name, CASES[name], options.autopilot, options.speed)
        if options.write:
            put_rows(DOCUMENT, marker, HEADINGS, list(CASES), {name: rows[name][1:]}, how)
    sys.stdout.write(table(HEADINGS, list(rows.values())) + "\n")


if __name__ == "__main__":
    main()
