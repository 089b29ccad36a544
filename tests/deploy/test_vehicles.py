"""Deployment of a run whose UAVs have processes: no plant, and the link to each autopilot."""

from contextlib import nullcontext
from pathlib import Path

import pytest

from tests.support.commands import transport
from transport.deploy.inventory import DeployError, Inventory, check_links, read_inventory
from transport.deploy.placements import placements
from transport.deploy.units import command, unit
from transport.protocol.network.mesh import process_names
from transport.protocol.scenario.scenario_file import read_scenario

ROOT = Path(__file__).resolve().parents[2]
SCENARIOS = ROOT / "scenarios"
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
    names = process_names(read_scenario(SCENARIOS / "flight.toml", ("plant.kind=vehicles",)))
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
    assert "Restart=no" in unit(placed["coordinator"], inventory, [])


def test_the_example_of_a_team_is_rendered(tmp_path: Path) -> None:
    """The commands at the top of the file work as they are, and the units can reach what they need.

    A coordinator that crashed is started again, as `flight` goes on without it, and is stopped only once
    the team is down; one whose run has ended is not.
    """
    pytest.importorskip("cryptography")
    lines = (ROOT / "deploy" / "hosts-flight.toml").read_text(encoding="utf-8").splitlines()
    commands = [line.removeprefix("#").split()[1:] for line in lines if "transport deploy" in line]
    for arguments in commands:
        given = [str(ROOT / one) if "hosts-flight" in one else one for one in arguments]
        result = transport(*given, cwd=tmp_path)
        assert result.returncode == 0, result.stderr
    ground = (tmp_path / "deployment/ground/systemd/transport-coordinator.service").read_text()
    assert "Restart=on-failure" in ground
    assert "RestartPreventExitStatus=2 3 4 5 6 7 11 130" in ground
    assert "TimeoutStopSec=infinity" in ground
    vehicle = (tmp_path / "deployment/uav1/systemd/transport-vehicle1.service").read_text()
    assert "--uav 1 --link udp:127.0.0.1:14550" in vehicle
    assert "PrivateDevices=yes" in vehicle
    assert "TimeoutStopSec=10" in vehicle
    # After a lost peer, 4, it rejoins the run; 2 and 3 refuse it, all others end it.
    assert "RestartPreventExitStatus=2 3 5 6 7 11 130" in vehicle


def test_a_vehicle_has_key_stand_and_device(tmp_path: Path) -> None:
    """What its command needs is in the inventory; a device of the host is open to it."""
    text = HOSTS.replace(
        'pose = "udp', 'key = "/etc/transport/mavlink.key"\nstands = true\npose = "udp'
    )
    (tmp_path / "hosts.toml").write_text(text)
    scenario = read_scenario(SCENARIOS / "flight.toml", ("plant.kind=vehicles",))
    names = process_names(scenario)
    inventory = read_inventory(tmp_path / "hosts.toml", names)
    placed = {each.process: each for each in placements(inventory, names, "tcp")}
    line = command(placed["vehicle3"], inventory)
    assert line[line.index("--key") + 1] == "/etc/transport/mavlink.key"
    assert "--stands" in line
    text = unit(placed["vehicle3"], inventory, [])
    assert "DeviceAllow=/dev/ttyACM0 rw" in text
    assert "PrivateDevices" not in text

    check_links(inventory.model_copy(update={"host": inventory.host[3:]}), "betaflight")
    with pytest.raises(DeployError, match=r"host.4.autopilot: expected udp.*serial:/dev/ttyACM0"):
        check_links(inventory, "ardupilot")
    with pytest.raises(DeployError, match=r"host.1.pose: expected the motion capture"):
        check_links(inventory, "betaflight")


BETAFLIGHT = "udp:0.0.0.0:14600"


@pytest.mark.parametrize(
    ("autopilot", "host", "refused"),
    [
        ("ardupilot", {"autopilot": "udp:127.0.0.1:14550"}, ""),
        ("px4", {"autopilot": "udpclient:127.0.0.1:14550"}, ""),
        ("px4", {"autopilot": "tcp:127.0.0.1:5760"}, "host.1.autopilot"),
        ("px4", {"autopilot": "serial:/dev/ttyACM0"}, "host.1.autopilot"),
        ("px4", {}, ""),
        ("betaflight", {"autopilot": "tcp:127.0.0.1:5761", "pose": BETAFLIGHT}, ""),
        ("betaflight", {"autopilot": "tcp:127.0.0.1:5761"}, "host.1.pose"),
        ("betaflight", {"runs": ["agent1"]}, ""),  # no vehicle needs a pose there
    ],
)
def test_links_are_those_of_the_autopilot(
    autopilot: str, host: dict[str, object], refused: str
) -> None:
    """MAVLink comes over UDP; a Betaflight needs motion capture beside its link."""
    only = {"name": "a", "address": "192.0.2.1", "runs": ["agent1", "vehicle1"], **host}
    inventory = Inventory.model_validate({"run": "team", "host": [only]})
    with pytest.raises(DeployError, match=refused) if refused else nullcontext():
        check_links(inventory, autopilot)


def test_at_most_one_host_records(tmp_path: Path) -> None:
    """There may be no recorder."""
    hosts = tmp_path / "hosts.toml"
    names = ["coordinator", "agent3", "agent4", "vehicle4", "agent1", "vehicle1", "agent2"]
    for count in (0, 1, 2):
        text = HOSTS.replace('"agent1", ', '"agent1", "recorder", ') if count else HOSTS
        text = text.replace('"agent2", ', '"agent2", "recorder", ') if count > 1 else text
        hosts.write_text(text)
        problem = "hosts.toml: host: expected one host that runs recorder, got 2"
        with pytest.raises(DeployError, match=problem) if count > 1 else nullcontext():
            read_inventory(hosts, [*names, "vehicle2", "vehicle3"])
