"""Deployment of a run whose UAVs have processes: no plant, and the link to each autopilot."""

from pathlib import Path

from transport.deploy.inventory import read_inventory
from transport.deploy.placements import placements
from transport.deploy.units import command, unit
from transport.protocol.network.mesh import process_names
from transport.protocol.scenario.scenario_file import read_scenario

SCENARIOS = Path(__file__).resolve().parents[2] / "scenarios"
HOSTS = """
run = "team"
insecure = true
[[host]]
name = "ground"
address = "192.0.2.10"
runs = ["coordinator", "agent3", "agent4", "vehicle4"]
[[host]]
name = "first"
address = "192.0.2.1"
runs = ["agent1", "vehicle1"]
autopilot = "udpclient:192.0.2.101:14555"
[[host]]
name = "second"
address = "192.0.2.2"
runs = ["agent2", "vehicle2"]
[[host]]
name = "third"
address = "192.0.2.3"
runs = ["vehicle3"]
autopilot = "serial:/dev/ttyACM0"
pose = "udp:0.0.0.0:14600"
"""


def test_a_vehicle_knows_its_autopilot(tmp_path: Path) -> None:
    """Each vehicle is started with its number and link, that of its host or the usual port, and again if it fails."""
    text = (SCENARIOS / "flight.toml").read_text(encoding="utf-8")
    file = tmp_path / "outside.toml"
    file.write_text(text.replace('autopilot = "stand_in"', 'kind = "vehicles"'))
    names = process_names(read_scenario(file))
    assert "plant" not in names

    hosts = tmp_path / "hosts.toml"
    hosts.write_text(HOSTS)
    inventory = read_inventory(hosts, names)
    placed = {each.process: each for each in placements(inventory, names, "tcp")}
    line = command(placed["vehicle1"], inventory)
    assert line[1:6] == ["vehicle", "--uav", "1", "--link", "udpclient:192.0.2.101:14555"]
    assert "udp:127.0.0.1:14551" in command(placed["vehicle2"], inventory)
    betaflight = ["--link", "serial:/dev/ttyACM0", "--pose", "udp:0.0.0.0:14600"]
    assert command(placed["vehicle3"], inventory)[4:8] == betaflight
    assert "Restart=on-failure" in unit(placed["vehicle2"], inventory, [])
