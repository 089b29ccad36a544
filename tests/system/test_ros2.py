"""An active run, seen through ROS 2's conventions by an implementation that shares no code with this one."""

import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.commands import Forked, free_base, settings, wait_for
from tests.support.live_log import LiveLog
from tests.support.same_flight import before, flight_bits, simulated_before
from transport.cli.commands.ros2 import PacedStart
from transport.protocol.wire.messages import Message, PlantState, Target

# Definitions as published by ROS 2, without comments.
DEFINITIONS = {
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "geometry_msgs/msg/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/msg/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n",
    "geometry_msgs/msg/Pose": "Point position\nQuaternion orientation\n",
}
POSE, POSE_DEFINITION = "geometry_msgs/msg/PoseStamped", "std_msgs/Header header\nPose pose\n"
PATH, PATH_DEFINITION = (
    "nav_msgs/msg/Path",
    "std_msgs/Header header\ngeometry_msgs/PoseStamped[] poses\n",
)
DOMAIN, SEEN = 7, 40  # poses, at 20 Hz
# The tests end their runs.
CLIMB = "maneuver.phase=[{name='climb',duration_s=120.0,displacement_m=[3.0,0.0,-5.0]}]"
# The least work: two agents, short horizons.
SMALL = ("agents.owned=[[1,2],[3,4]]", "controller.horizon=5")
HOVER = "maneuver.phase=[{name='hover',duration_s=120.0,displacement_m=[0,0,0]}]"


@pytest.fixture(scope="module")
def sdk(forked: Callable[..., Forked], tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The other implementation, with one session a process, and a router of this project in place of that of ROS 2."""
    module = pytest.importorskip("zenoh_ros2_sdk")
    module.port = free_base()
    endpoint = f"tcp/127.0.0.1:{module.port}"
    forked("router", "--listen", endpoint, cwd=tmp_path_factory.mktemp("router"))
    return module


def described(kind: str, definition: str, others: dict[str, str]) -> tuple[str, str]:
    """Return definition and hash of a type by the other implementation."""
    from zenoh_ros2_sdk.utils import get_type_hash

    whole = definition + "".join(
        f"{'=' * 80}\nMSG: {name}\n{text}" for name, text in others.items()
    )
    return whole, get_type_hash(kind, msg_definition=definition, dependencies=others)


def subscribe(
    sdk: Any, topic: str, kind: str, definition: str, others: dict[str, str], heard: list[Any]
) -> Any:
    """Subscribe with the other implementation, which computes the hash of the type from the definitions."""
    whole, digest = described(kind, definition, others)
    return sdk.ROS2Subscriber(
        topic,
        kind,
        heard.append,
        msg_definition=whole,
        type_hash=digest,
        domain_id=DOMAIN,
        router_port=sdk.port,
    )


class Publisher:
    """Publisher of targets, by the other implementation."""

    def __init__(self, sdk: Any, port: int, topic: str = "/target") -> None:
        whole, digest = described(POSE, POSE_DEFINITION, DEFINITIONS)
        described_as = {
            "msg_definition": whole,
            "type_hash": digest,
            "domain_id": DOMAIN,
            "router_port": port,
        }
        self._publisher = sdk.ROS2Publisher(topic, POSE, **described_as)
        self.close = self._publisher.close

    def send(self, x: float, y: float, z: float, frame: str = "map") -> None:
        """Publish a position."""
        kinds = {name: self._publisher.session_mgr.store.types[name] for name in DEFINITIONS}
        stamp = kinds["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
        point = kinds["geometry_msgs/msg/Point"](x=x, y=y, z=z)
        turn = kinds["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
        pose = kinds["geometry_msgs/msg/Pose"](position=point, orientation=turn)
        self._publisher.publish(
            header=kinds["std_msgs/msg/Header"](stamp=stamp, frame_id=frame), pose=pose
        )


def tokens(sdk: Any, subscriber: Any) -> list[str]:
    """Return the tokens of publishers of a topic, by the other implementation's form of them."""
    from zenoh_ros2_sdk.entity import EndpointEntity, EntityKind, NodeEntity
    from zenoh_ros2_sdk.keyexpr import endpoint_liveliness_keyexpr

    node = NodeEntity(domain_id=DOMAIN, session_id="*", node_id=0, node_name="transport")
    publisher = EndpointEntity(
        node=node,
        entity_id="*",
        kind=EntityKind.PUBLISHER,
        name=subscriber.topic,
        dds_type_name=subscriber.dds_type_name,
        type_hash=subscriber.type_hash,
        qos=subscriber.qos,
    )
    replies = subscriber.session_mgr.liveliness.get(
        endpoint_liveliness_keyexpr(publisher), timeout=5.0
    )
    return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]


@pytest.mark.slow
def test_a_run_is_seen_and_does_not_notice(
    sdk: Any, forked: Callable[..., Forked], tmp_path: Path
) -> None:
    """Poses at 20 Hz and plans are seen.

    With a bridge, and one that is killed, the bits are those of a run alone.
    """
    poses: list[Any] = []
    plans: list[Any] = []
    options = settings("clock.speed=1.0", CLIMB, *SMALL)
    run = forked("run", "resilient", *options, "--out", "run", "--no-figures", cwd=tmp_path)
    bridges, log = list[Forked](), LiveLog(tmp_path / "run" / "run.mcap")
    kept = [
        subscribe(sdk, "/payload/pose", POSE, POSE_DEFINITION, DEFINITIONS, poses),
        subscribe(
            sdk, "/uav1/plan", PATH, PATH_DEFINITION, {**DEFINITIONS, POSE: POSE_DEFINITION}, plans
        ),
    ]
    try:
        assert wait_for(lambda: len(log.of(PlantState)) > 0)
        for domain in (DOMAIN, DOMAIN + 1):
            bridge = ("--domain", str(domain), "--connect", f"tcp/127.0.0.1:{sdk.port}")
            bridges.append(forked("ros2", "--run", "run", *bridge, cwd=tmp_path))
        assert wait_for(lambda: len(poses) > 0)
        assert [len(tokens(sdk, subscriber)) for subscriber in kept] == [1, 1]
        bridges[1].process.kill()
        assert wait_for(lambda: len(poses) >= SEEN)
        run.process.send_signal(signal.SIGINT)
        run.end()
        assert bridges[0].end()[0] == 0
    finally:
        for subscriber in kept:
            subscriber.close()
    x = np.array([state.x for state in log.of(PlantState)])
    until = len(x) - 10
    alone = simulated_before(until, tmp_path / "run" / "scenario.toml", "clock.speed=1.0")
    assert flight_bits(alone) == flight_bits(before(until, log.of(Message)))
    ticks = {tuple(row): tick for tick, row in enumerate(x[:, :3].tolist())}
    points = [pose.pose.position for pose in poses]
    seen = [ticks[point.x, point.y, point.z] for point in points]
    assert seen == list(range(seen[0], seen[0] + len(seen)))
    stamps_s = [pose.header.stamp.sec + 1e-9 * pose.header.stamp.nanosec for pose in poses]
    assert (stamps_s[-1] - stamps_s[0]) / (seen[-1] - seen[0]) == pytest.approx(0.05, rel=0.1)
    assert {
        (pose.header.frame_id, len(plan.poses)) for pose, plan in zip(poses, plans, strict=False)
    } == {("inertial", 6)}


@pytest.mark.slow
@pytest.mark.parametrize("waits", [False, True])
def test_stamps_are_times_of_the_wall_clock(*, waits: bool) -> None:
    """A tick is stamped by its time, not by when it was recorded, and later by what the clock waited."""
    begun_ns, period_ns = 10**18, 50_000_000
    start = PacedStart(period_ns=period_ns, speed=1.0, waits=waits)
    late_ns = (3_000_000, 1_000_000, 40_000_000)
    for tick, by_ns in enumerate(late_ns):
        start.note(tick, begun_ns + tick * period_ns + by_ns)
    assert start.stamp_ns(2) == begun_ns + 2 * period_ns + min(late_ns)

    waited_ns = 5 * 10**9
    start.note(3, begun_ns + 3 * period_ns + waited_ns)
    assert start.stamp_ns(3) == begun_ns + 3 * period_ns + (waited_ns if waits else min(late_ns))


def test_the_bridge_of_a_killed_run_ends(forked: Callable[..., Forked], tmp_path: Path) -> None:
    """The bridge ends with exit code 0 when the run is killed, whose log then has no end."""
    endpoint = f"tcp/127.0.0.1:{free_base()}"
    forked("router", "--listen", endpoint, cwd=tmp_path)
    options = settings("clock.speed=1.0", HOVER, *SMALL)
    run = forked("run", "resilient", *options, "--out", "run", "--no-figures", cwd=tmp_path)
    log = LiveLog(tmp_path / "run" / "run.mcap")
    assert wait_for(lambda: len(log.of(PlantState)) > 0)
    bridge = forked("ros2", "--run", "run", "--connect", endpoint, cwd=tmp_path)
    assert wait_for(lambda: "topics in domain" in bridge.output.read_text())
    run.process.kill()
    assert bridge.end()[0] == 0


@pytest.mark.slow
def test_targets_come_from_outside(sdk: Any, forked: Callable[..., Forked], tmp_path: Path) -> None:
    """Targets of the other implementation are announced.

    A flood with NaN is refused, named, and changes no bit.
    """
    options = settings("clock.speed=1.0", HOVER, *SMALL)
    run = forked("run", "precise", *options, "--out", "run", "--no-figures", cwd=tmp_path)
    log = LiveLog(tmp_path / "run" / "run.mcap")
    publisher = Publisher(sdk, sdk.port)
    send = publisher.send

    def targets() -> list[list[float]]:
        return [target.points[0].tolist() for target in log.of(Target)]

    try:
        assert wait_for(lambda: len(log.of(PlantState)) > 0)
        bridge = forked(
            "ros2",
            "--run",
            "run",
            "--domain",
            str(DOMAIN),
            "--connect",
            f"tcp/127.0.0.1:{sdk.port}",
            cwd=tmp_path,
        )
        places = [(0.5, 0.0, 10.0), (0.5, -0.5, 10.5)]
        for x, y, z in places:

            def is_known(place: tuple[float, float, float] = (x, y, z)) -> bool:
                send(*place)  # the bridge subscribes some time after its start
                return wait_for(lambda: targets()[-1:] == [[place[0], -place[1], -place[2]]], 3.0)

            assert wait_for(is_known)
        to_one = Publisher(sdk, sdk.port, "/agent2/target")
        to_one.send(0.5, -0.5, 10.2)
        assert wait_for(lambda: [target.to for target in log.of(Target)] == [(), (), (2,)])
        to_one.close()
        flooded = len(log.of(PlantState))
        for _ in range(200):
            send(float("nan"), 0.0, 0.0)
        assert wait_for(lambda: len(log.of(PlantState)) > flooded + 20)
        send(1.0, 0.0, 10.0, frame="odom")  # the bridge takes the newest, every half second
        assert wait_for(lambda: len(log.of(PlantState)) > flooded + 40)
        assert targets()[-1] == [0.5, 0.5, -10.2]
        run.process.send_signal(signal.SIGINT)
        run.end()
        code, printed = bridge.end()
        assert code == 0, printed
    finally:
        publisher.close()
    assert "/target: expected a finite position" in printed
    assert "/target: expected the frame" in printed
    script = (
        f"{{at_s={t.tick * 0.05!r},points_m={t.points.tolist()},to={[*t.to]}}}"
        for t in log.of(Target)
    )
    until = log.of(PlantState)[-1].tick - 10
    alone = simulated_before(
        until, tmp_path / "run" / "scenario.toml", f"maneuver.target=[{','.join(script)}]"
    )
    assert len(flight_bits(alone)) == until * 3
    assert flight_bits(alone) == flight_bits(before(until, log.of(Message)))
