"""Driver of an autopilot that speaks MAVLink: one that it does not hear, and one of which it has heard little."""

import time

from tests.support.bench import free_udp_port
from transport.mpc.settings_period_horizon_weights import Limits
from transport.protocol.network.mavlink import Endpoint, MavlinkLink, messages
from transport.protocol.scenario.sections.vehicles_section import VehiclesSection
from transport.vehicle.start import LinkOptions, open_autopilot


def test_an_autopilot_with_another_system_id_is_named() -> None:
    """The system id must be the number of the UAV: the ids that are heard instead are told."""
    port = free_udp_port()
    links = LinkOptions(link=f"udp:127.0.0.1:{port}")
    driver = open_autopilot(VehiclesSection(), Limits(thrust_N=(0.0, 30.0)), 1, links)
    other = MavlinkLink(Endpoint(True, "127.0.0.1", port), (7, 1), 0)
    try:
        assert driver.silence() == "no sign of life from the autopilot"
        end_s = time.monotonic() + 20.0
        while "heard" not in driver.silence() and time.monotonic() < end_s:
            other.send(messages().MAVLink_heartbeat_message(2, 3, 0, 0, 0, 3))
            time.sleep(0.05)
        assert "expected system 1, the number of the UAV, heard 7 (MAV_SYSID" in driver.silence()
        assert driver.state() is None
    finally:
        other.close()
        driver.close()


def test_a_process_that_returns_in_flight_asks_for_the_heartbeat() -> None:
    """Any message is enough to ask for the mode and whether it is armed, which are told once a second."""
    port = free_udp_port()
    links = LinkOptions(link=f"udp:127.0.0.1:{port}")
    driver = open_autopilot(VehiclesSection(), Limits(thrust_N=(0.0, 30.0)), 1, links)
    autopilot = MavlinkLink(Endpoint(True, "127.0.0.1", port), (1, 1), 0)
    m = messages()
    asked: set[int] = set()
    try:
        end_s = time.monotonic() + 20.0
        while m.MAVLINK_MSG_ID_HEARTBEAT not in asked and time.monotonic() < end_s:
            autopilot.send(m.MAVLink_attitude_message(0, *[0.0] * 6))
            driver.attend(time.monotonic_ns())
            asked |= {
                round(message.param1)
                for message in autopilot.receive(0.05)
                if message.get_type() == "COMMAND_LONG"
                and message.command == m.MAV_CMD_REQUEST_MESSAGE
            }
        assert m.MAVLINK_MSG_ID_HEARTBEAT in asked
    finally:
        autopilot.close()
        driver.close()
