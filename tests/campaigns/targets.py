"""Ten targets in a row, a figure-eight by hand.

`python -m tests.campaigns.targets [WAY ...] [--gusts]`.

By each way (command, Python, a page of the viewer in a browser, another implementation of ROS 2),
on a perfect network and with 200 ms delay, 30 % packet loss and an agent that is killed and
restarted. Exit code 0 only if the payload has reached every target within 5 cm, and the replays of
all agents have the same bits. It prints a table of docs/record/results.md.
"""

import argparse
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import transport
from docs import tables
from tests.support.browser import browser
from tests.support.commands import free_base, processes_of, settings, start, wait_for
from tests.support.commands import transport as command
from tests.support.live_log import LiveLog
from tests.system.test_live_viewer import page_of
from tests.system.test_ros2 import DOMAIN, Publisher
from transport.analysis.cost_and_tracking_metrics import SETTLED_S
from transport.analysis.replay.replay_difference import Comparison
from transport.analysis.replay.replay_of_agent import Replay
from transport.flight import active_runs
from transport.log.run_folder import open_run
from transport.protocol.wire.messages import PlantState, Target

Place = tuple[float, float, float]
PHASES = np.linspace(0.0, 2.0 * np.pi, 9)[1:]
PLACES = [
    *zip(np.sin(PHASES).round(2), (0.5 * np.sin(2.0 * PHASES)).round(2), [-10.0] * 8, strict=True)
]
PLACES += [(0.5, -0.5, -10.5), (0.0, 0.0, -10.0)]
REACHED_M = 0.05
LATE = ("links.delay_s=0.2", "links.loss=0.3")
# Before the targets with these numbers, from 0.
VICTIM, FAULTS = (
    "agent3",
    {3: "kill", 6: "restart"},
)
ROUTER_PORT = free_base()  # the other implementation has one session in a process
_KNOWN_S = 20.0


@contextmanager
def by(way: str, folder: Path, address: str) -> Iterator[Callable[[Place], object]]:
    """Yield the function that gives the active run of a folder a target in one of the ways."""
    if way == "command":
        yield lambda place: command("target", *map(str, place), "--run", folder, cwd=folder)
    elif way == "Python":
        yield lambda place: transport.active(folder).target(*place)
    elif way == "viewer":
        with browser() as page:
            page.open(address)

            def go(place: Place) -> None:
                page.type("x, y, z (m)", ", ".join(map(str, place)))
                page.click("Go there")

            yield go
    else:
        import zenoh_ros2_sdk

        router = f"tcp/127.0.0.1:{ROUTER_PORT}"
        bridge = start(
            "ros2", "--run", folder, "--domain", str(DOMAIN), "--connect", router, cwd=folder
        )
        try:
            with closing(Publisher(zenoh_ros2_sdk, ROUTER_PORT)) as publisher:
                yield lambda place: publisher.send(*place, frame="inertial")
        finally:
            bridge.terminate()
            bridge.communicate()


def flown(way: str, late: bool, gusts: bool, folder: Path) -> tuple[list[float], int, int]:
    """Fly to all targets; return the payload's distances from them, m, numbers of plans, and of equal replayed ones."""
    calm = () if gusts else ("plant.wind.gust_mps=[0,0,0]",)
    options = (
        "--no-figures",
        "--out",
        folder.name,
        *(("--view", "--port", "0") if way == "viewer" else ()),
    )
    run = start(
        "run", "playground", *settings(*calm, *(LATE if late else ())), *options, cwd=folder.parent
    )
    try:
        address = page_of(run) if way == "viewer" else ""
        assert wait_for(lambda: active_runs.read(folder) is not None)
        log = LiveLog(folder / "run.mcap")
        assert wait_for(lambda: bool(log.of(PlantState)))
        with by(way, folder, address) as give:
            for number, place in enumerate(PLACES):
                if late and number in FAULTS:
                    done = command("fault", FAULTS[number], VICTIM, "--run", folder, cwd=folder)
                    assert done.returncode == 0, done.stderr

                def is_known(place: Place = place) -> bool:
                    give(place)  # again, if nothing listens yet
                    return wait_for(
                        lambda: [t.points[0].tolist() for t in log.of(Target)][-1:] == [[*place]],
                        _KNOWN_S,
                    )

                assert wait_for(is_known)
                target = log.of(Target)[-1]
                settled = target.tick + round((target.approach_s + SETTLED_S) / 0.05) + 1
                assert wait_for(lambda settled=settled: log.of(PlantState)[-1].tick > settled)  # type: ignore[misc]
    finally:
        run.send_signal(signal.SIGINT)
        run.communicate(timeout=60)
    assert processes_of(folder.name) == {}
    whole, comparison = open_run(folder), Comparison()
    for agent in whole.setup.agents:
        for step in Replay(whole.setup, whole.log, agent).steps():
            comparison.add(step)
    errors_m = [target["error_m"] for target in transport.load(folder).summary["targets"]]
    return (
        [error_m for error_m in errors_m if error_m is not None],
        comparison.plans,
        comparison.identical,
    )


def main() -> int:
    """Fly by the ways of the command line; print a row for each flight and return the exit code."""
    ways = ("command", "Python", "viewer", "ROS 2")
    parser = argparse.ArgumentParser(prog="python -m tests.campaigns.targets", description=__doc__)
    parser.add_argument(
        "ways", nargs="*", default=ways, help=f"of {', '.join(ways)}; all by default"
    )
    parser.add_argument("--gusts", action="store_true", help="with the gusts of playground")
    options = parser.parse_args()
    rows, done = list[tuple[str, ...]](), True
    router = start("router", "--listen", f"tcp/127.0.0.1:{ROUTER_PORT}", cwd=Path.cwd())
    try:
        for way, late in product(options.ways, (False, True)):
            with TemporaryDirectory() as folder:
                errors_m, plans, identical = flown(
                    way, late, options.gusts, Path(folder) / "targets"
                )
            near = sum(error_m < REACHED_M for error_m in errors_m)
            network = "200 ms, 30 % loss, an agent killed and restarted" if late else "perfect"
            counts = (
                f"{near} of {len(errors_m)}",
                f"{100.0 * max(errors_m):.1f}",
                f"{identical} of {plans}",
            )
            rows.append((way, network, *counts))
            sys.stderr.write(f"{way}, {network}: {', '.join(counts)}\n")
            done &= near == len(errors_m) >= len(PLACES) and plans == identical > 0
    finally:
        router.terminate()
        router.communicate()
    columns = (
        "targets by",
        "network",
        "reached within 5 cm",
        "largest error, cm",
        "replayed plans with the same bits",
    )
    sys.stdout.write(f"{tables.table(columns, rows)}\n")
    return 0 if done else 1


if __name__ == "__main__":
    sys.exit(main())
