"""An intruder that sends invalid messages on every key changes neither a run nor its record."""

import json
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
import zenoh

from protocol.scenario.file import find_scenario, read_scenario
from protocol.scenario.setup import Setup
from protocol.wire.keys import Keys
from protocol.wire.messages import agent_name
from tests.support.attacker import Deliveries, bombard, intruding, proofs_of_connection, table
from tests.support.commands import PATIENCE_S, free_base, settings, start
from tests.support.garbage import Garbage
from tests.support.logs import record_run
from tests.system.test_processes import SCHEMA
from transport.report.report import write_report

SEED = 20240611
RUN = "disturbed"

# Paced to half of real time, so that the intruder has time to send, also on a busy machine.
TICKS = 120
FLIGHT = (
    f"maneuver.phase=[{{name='climb',duration_s={0.05 * TICKS},displacement_m=[0.0,0.0,-1.0]}}]",
    "controller.horizon=5",
    "clock.speed=0.5",
)

# Number of bad messages: in total, on a busy machine at least, and at a time; the last are sent well before the end.
SHOTS, FEWEST, BURST, LAST_TICK = 4000, 1000, 120, 80

# Messages of three ticks: older ones have reached all processes.
DELAY = 60

# Tokens of processes that cannot exist.
STRANGE_TOKENS = ("alive/agent1/soon/0123456789ab", "alive/agent1", "ready/agent1/x")


@pytest.mark.slow
def test_an_intruder(tmp_path: Path) -> None:
    """Thousands of bad messages on every key change no value in steps.csv, and the summary counts all by sender."""
    base = free_base()
    run = Setup.of(read_scenario(find_scenario("paper"), FLIGHT), "paper")
    agents = [agent_name(agent) for agent in run.agents]
    receivers = ["coordinator", "plant", *agents]  # no intruder reaches the recorder, which has no listening port
    keys = Keys(RUN)
    command = [
        "run",
        "paper",
        *settings(*FLIGHT, f"network.base_port={base}", "network.secret=false"),
        "--out",
        RUN,
        "--no-figures",
    ]
    process = start(*command, "--format", "json", cwd=tmp_path)

    delivered = Deliveries(keys, receivers, relayed=True)
    max_bytes = run.shape.max_bytes
    rng = np.random.default_rng(SEED)
    source = Garbage("recorder", keys, run, max_bytes, rng, incarnation=0, delay=DELAY)
    with intruding(keys, [f"tcp/127.0.0.1:{port}" for port in range(base, base + len(receivers))]) as mesh:
        shots, tokens = 0, list[zenoh.LivelinessToken]()
        attack = bombard(
            mesh,
            source,
            process,
            proofs_of_connection(keys, run.agents, relayed=True),
            shots=SHOTS,
            until_tick=LAST_TICK,
            burst=BURST,
            pause_s=0.02,
            timeout_s=PATIENCE_S,
        )
        for _, key, data in attack:
            shots += 1
            delivered.add(key, data)
            if shots % BURST == 0 and len(tokens) < len(STRANGE_TOKENS):
                strange = f"{keys.prefix}/{STRANGE_TOKENS[len(tokens)]}"
                tokens.append(mesh.session.liveliness().declare_token(strange))
                delivered.single = {name: count + 1 for name, count in delivered.single.items()}
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
    assert delivered.accepted(counts) == {}
    assert summary["messages"]["rejected"] == sum(counts.values())
    assert {"agent2", "plant", "plan/2"} <= {entry["sender"] for entry in summary["rejections"]}
    reasons = {entry["reason"] for entry in summary["rejections"]}
    assert {"malformed", "oversized", "not_finite", "replayed", "past", "wrong_sender"} <= reasons

    record_run(run, tmp_path / "calm")
    write_report(tmp_path / "calm", figures=False)
    assert table(tmp_path / RUN) == table(tmp_path / "calm")
