"""An intruder that sends invalid messages on every key changes neither a run nor its record."""

import csv
import json
import queue
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
import zenoh

from protocol.admission.admission import Admission
from protocol.scenario.file import find_scenario, read_scenario
from protocol.scenario.setup import Setup
from protocol.wire.codec import decode
from protocol.wire.keys import Keys, matches
from protocol.wire.messages import Bundle, MessageError, agent_name
from protocol.wire.rejections import Rejections
from tests.support.commands import PATIENCE_S, free_base, settings, start
from tests.support.garbage import Garbage
from tests.support.logs import record_run
from tests.system.test_processes import SCHEMA
from transport.analysis.steps import WALL_CLOCK
from transport.report.report import write_report

SEED = 20240611
RUN = "disturbed"

# Paced to real time, so that the intruder has time to send.
TICKS = 120
FLIGHT = (
    f"maneuver.phase=[{{name='climb',duration_s={0.05 * TICKS},displacement_m=[0.0,0.0,-1.0]}}]",
    "controller.horizon=5",
    "clock.speed=1.0",
)

# Number of bad messages: in total, on a busy machine at least, and at a time; the last are sent well before the end.
SHOTS, FEWEST, BURST, LAST_TICK = 4000, 1000, 40, 100

# Messages in a bundle: plan and report of four agents, and a tick.
MOST_PARTS = 9

# Messages of three ticks: older ones have reached all processes.
DELAY = 60

# Tokens of processes that cannot exist.
STRANGE_TOKENS = ("alive/agent1/soon/0123456789ab", "alive/agent1", "ready/agent1/x")


class Mesh:
    """A session with connections to every process of a run, and the messages it receives.

    Args:
        session: Session with connections to all processes.
        keys: Keys of the run.
    """

    def __init__(self, session: zenoh.Session, keys: Keys) -> None:
        self.session, self.keys = session, keys
        self._inbox: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        self._subscriber = session.declare_subscriber(f"{keys.prefix}/**", self._inbox.put)

    def heard(self) -> Iterator[tuple[str, bytes]]:
        """Return keys and bytes of the messages received since the last call."""
        while not self._inbox.empty():
            sample = self._inbox.get()
            yield str(sample.key_expr), sample.payload.to_bytes()

    def put(self, key: str, data: bytes) -> None:
        """Send bytes to all subscribers of a key; wait rather than lose them."""
        remote, block = zenoh.Locality.REMOTE, zenoh.CongestionControl.BLOCK
        self.session.put(key, data, congestion_control=block, allowed_destination=remote)


@contextmanager
def intruding(keys: Keys, ports: Sequence[int]) -> Iterator[Mesh]:
    """Connect to every process of a run like an observer."""
    configuration = {
        "mode": "peer",
        "connect": {
            "endpoints": [f"tcp/127.0.0.1:{port}" for port in ports],
            "timeout_ms": -1,
            "retry": {"period_init_ms": 50, "period_max_ms": 200, "period_increase_factor": 1.5},
        },
        "listen": {"endpoints": []},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
    }
    with zenoh.open(zenoh.Config.from_json5(json.dumps(configuration))) as session:
        yield Mesh(session, keys)


def table(folder: Path) -> list[dict[str, str]]:
    """Return the step table without its wall-clock columns."""
    with (folder / "steps.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    return [{name: value for name, value in row.items() if not name.endswith(WALL_CLOCK)} for row in rows]


def is_bundle(data: bytes) -> bool:
    """Return whether bytes can be read as a bundle, of which each message is counted by itself."""
    try:
        return isinstance(decode(data), Bundle)
    except MessageError:
        return False


@pytest.mark.slow
@pytest.mark.parametrize("exchange", ["relayed", "direct"])
def test_an_intruder(exchange: str, tmp_path: Path) -> None:
    """Thousands of bad messages on every key change no value in steps.csv, and the summary counts all by sender."""
    base = free_base()
    flight = (*FLIGHT, f"clock.exchange={exchange}")
    run = Setup.of(read_scenario(find_scenario("paper"), flight), "paper")
    agents = [agent_name(agent) for agent in run.agents]
    receivers = ["coordinator", "plant", *agents]  # no intruder reaches the recorder, which has no listening port
    keys = Keys(RUN)
    hears = {name: keys.subscriptions(name, relayed=exchange == "relayed") for name in receivers}
    command = [
        "run",
        "paper",
        *settings(*flight, f"network.base_port={base}", "network.secret=false"),
        "--out",
        RUN,
        "--no-figures",
    ]
    process = start(*command, "--format", "json", cwd=tmp_path)

    expected, bundles = dict.fromkeys(receivers, 0), dict.fromkeys(receivers, 0)
    max_bytes = Admission("recorder", keys, run, Rejections()).max_bytes
    rng = np.random.default_rng(SEED)
    source = Garbage("recorder", keys, run, max_bytes, rng, incarnation=0, delay=DELAY)
    with intruding(keys, range(base, base + len(receivers))) as mesh:
        shots, tokens = 0, list[zenoh.LivelinessToken]()
        # A received message proves the connection: coordinator, plant and agents publish at every tick.
        ends = ("tick", "plant_state") if exchange == "direct" else ("relay", "record")
        each = "plan" if exchange == "direct" else "answer"
        everything = {f"{keys.prefix}/{end}" for end in (*ends, *(f"{each}/{agent}" for agent in run.agents))}
        known: set[str] = set()
        until = time.monotonic() + PATIENCE_S
        while source.tick < LAST_TICK and time.monotonic() < until and process.poll() is None:
            for key, data in mesh.heard():
                source.heard(key, data)
                known.add(key)
            if source.tick < 1 or not everything <= known or shots >= SHOTS:
                time.sleep(0.01)
                continue
            for _ in range(BURST):
                _, key, data = source.next()
                mesh.put(key, data)
                shots += 1
                for name, expressions in hears.items():
                    counts = bundles if is_bundle(data) else expected
                    counts[name] += any(matches(expression, key) for expression in expressions)
            if len(tokens) < len(STRANGE_TOKENS):
                strange = f"{keys.prefix}/{STRANGE_TOKENS[len(tokens)]}"
                tokens.append(mesh.session.liveliness().declare_token(strange))
                expected = {name: count + 1 for name, count in expected.items()}
            time.sleep(0.01)
        printed, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, errors
    assert shots >= FEWEST

    summary: dict[str, Any] = json.loads(printed)
    jsonschema.validate(summary, SCHEMA)
    assert summary["outcome"] == "completed"
    assert summary["ticks"] == TICKS
    counts = dict.fromkeys(receivers, 0)
    for entry in summary["rejections"]:
        counts[entry["by"]] += entry["count"]
    extra = {name: counts[name] - expected[name] for name in receivers}
    assert all(0 <= extra[name] <= MOST_PARTS * bundles[name] for name in receivers), (extra, bundles)
    assert (exchange == "direct") == (sum(bundles.values()) == 0) == (sum(extra.values()) == 0)
    assert summary["messages"]["rejected"] == sum(counts.values())
    assert {"agent2", "plant", "plan/2"} <= {entry["sender"] for entry in summary["rejections"]}
    reasons = {entry["reason"] for entry in summary["rejections"]}
    assert {"malformed", "oversized", "not_finite", "replayed", "past", "future", "wrong_sender"} <= reasons

    record_run(run, tmp_path / "calm")
    write_report(tmp_path / "calm", figures=False)
    assert table(tmp_path / RUN) == table(tmp_path / "calm")
