"""The bag of a run for ROS 2, read back by rosbags: values, frames, and what each topic is for."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from scipy.spatial.transform import Rotation

import transport
from tests.support.commands import transport as command
from transport.model.physics.rotations import rotation
from transport.model.state import StateView
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import PlantState
from transport.scene.scene_at_tick import SceneBuilder

pytest.importorskip("rosbags", reason="needs the extra ros2")
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from transport.cli.commands.ros2 import PacedStart
from transport.report.ros2_bag import (
    TARGET_TYPE,
    GoalError,
    Ros2Messages,
    cdr,
    goal_in,
    types,
    write_bag,
)

PHASES = [{"name": "move", "duration_s": 0.5, "displacement_m": [0.1, 0.05, -0.2]}]
PAGE = Path(__file__).resolve().parents[3] / "docs" / "ros2.md"
# Central differences over 50 ms of a motion with a jerk of 20 m/s^3 at most.
SLOPE_MPS = 0.01
ROUNDING = 1e-12  # m, rad/s
# As ROS 2 publishes them (since Iron).
HASHES = {
    "geometry_msgs/msg/PoseStamped": "RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
}


def named_frames(N: int) -> set[str]:
    """Return the frames that docs/ros2.md names, for a team of N UAVs."""
    section = PAGE.read_text(encoding="utf-8").partition("### Frames")[2].partition("\n## ")[0]
    names = re.findall(r"^\| `(\w+)`", section, re.MULTILINE)
    numbered = {f"{name[:-1]}{i + 1}" for name in names if name.endswith("1") for i in range(N)}
    return numbered | {name for name in names if not name.endswith("1")}


@pytest.fixture(scope="module")
def run() -> transport.Run:
    """Return a run of ten ticks."""
    return transport.fly("resilient", phases=PHASES, progress=False)


def test_the_bag_holds_the_run(run: transport.Run, tmp_path: Path) -> None:
    """Every tick has poses, twists, plans, transforms and markers.

    Poses and twists are those of the plant.
    """
    setup = Setup.of(run.scenario.validated, "test")
    bag = tmp_path / "bag.mcap"
    assert write_bag(SceneBuilder.of(setup, run.log), run.log, bag) == 10
    x = np.array([state.x for state in run.log.of(PlantState)])
    view, store = StateView(x), get_typestore(Stores.ROS2_JAZZY)
    found: dict[str, list[Any]] = {}
    with Reader(bag) as reader:
        for connection, at_ns, raw in reader.messages():
            found.setdefault(connection.topic, []).append(
                store.deserialize_cdr(raw, connection.msgtype)
            )
            assert at_ns % setup.period_ns == 0
    bodies = ["payload", "uav1", "uav2", "uav3", "uav4"]
    expected = {
        "/tf",
        "/markers",
        "/reference/pose",
        *(f"/{b}/{what}" for b in bodies for what in ("pose", "twist")),
    }
    expected |= {f"/uav{i}/plan" for i in range(1, 5)} | {
        f"/agent{i}/payload/plan" for i in range(1, 5)
    }
    assert {topic: len(messages) for topic, messages in found.items()} == dict.fromkeys(
        expected, 10
    )
    for k, pose in enumerate(found["/payload/pose"]):
        at, turn = pose.pose.position, pose.pose.orientation
        assert [at.x, at.y, at.z] == x[k, :3].tolist()
        R = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
        np.testing.assert_allclose(R, rotation(view.Theta0[k]), atol=1e-12)
    twists = found["/payload/twist"]
    told = [[getattr(t.twist.linear, axis) for axis in "xyz"] for t in twists]
    velocities_I = [rotation(view.Theta0[k]) @ view.v0_P[k] for k in range(10)]
    np.testing.assert_allclose(told, velocities_I, atol=ROUNDING)
    told = [[getattr(t.twist.angular, axis) for axis in "xyz"] for t in twists]
    omega0_I = [rotation(view.Theta0[k]) @ view.omega0_P[k] for k in range(10)]
    np.testing.assert_allclose(told, omega0_I, atol=ROUNDING)
    turn = found["/uav3/pose"][-1].pose.orientation
    R = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    np.testing.assert_allclose(R, rotation(view.Theta[9, 2]), atol=ROUNDING)
    # The velocity of a UAV is the slope of its position, to the second order of the period.
    places = np.array(
        [[getattr(p.pose.position, axis) for axis in "xyz"] for p in found["/uav2/pose"]]
    )
    speeds = np.array(
        [[getattr(t.twist.linear, axis) for axis in "xyz"] for t in found["/uav2/twist"]]
    )
    np.testing.assert_allclose((places[2:] - places[:-2]) / 0.1, speeds[1:-1], atol=SLOPE_MPS)
    velocities_I = [setup.model.velocities(one)[2] for one in x]  # r_i' of docs/equations.md (39)
    np.testing.assert_allclose(speeds, velocities_I, atol=ROUNDING)
    # Twists and the goal are stated in the inertial frame.
    angular = [[getattr(t.twist.angular, axis) for axis in "xyz"] for t in found["/uav2/twist"]]
    omega_I = [rotation(view.Theta[k, 1]) @ view.omega_B[k, 1] for k in range(10)]
    np.testing.assert_allclose(angular, omega_I, atol=ROUNDING)
    goals = [[getattr(p.pose.position, axis) for axis in "xyz"] for p in found["/reference/pose"]]
    times_s = np.linspace(0.0, 9 * setup.settings.sampling_period_s, 10)
    goals_I, _ = setup.maneuver.path(times_s)
    np.testing.assert_allclose(goals, goals_I, atol=ROUNDING)
    tree = {t.child_frame_id: t.header.frame_id for t in found["/tf"][-1].transforms}
    assert tree["inertial"] == "map"
    assert {tree[name] for name in (*bodies, "rod1")} == {"inertial"}
    assert tree.keys() | {"map"} == named_frames(setup.system.N)
    first, last = (found["/markers"][k].markers for k in (0, -1))
    assert {marker.type for marker in first} == {5, 9, 11}
    assert {marker.header.frame_id for marker in [*first, *last]} <= {*tree}
    assert len(first) > len(last) > 0
    assert all(len(marker.points) > 0 for marker in [*first, *last] if marker.type == 5)


def test_the_bag_of_a_log_without_its_beginning_has_the_bodies_at_its_first_tick(
    run: transport.Run, tmp_path: Path
) -> None:
    """Messages are stamped with scenario time in the file, too, whose metadata are those of the log."""
    setup = Setup.of(run.scenario.validated, "test")
    store: Any = get_typestore(Stores.ROS2_JAZZY)
    bag = tmp_path / "bag.mcap"
    part = replace(run.log, messages=tuple(e for e in run.log.messages if e.message.tick > 7))
    assert write_bag(SceneBuilder.of(setup, part), part, bag) == 2
    with bag.open("rb") as stream:
        reader = make_reader(stream)
        told = [entry for _, _, entry in reader.iter_messages(["/markers"])]
        (header,) = [one.metadata for one in reader.iter_metadata() if one.name == "exported run"]
    assert header == run.log.header
    assert [(entry.log_time, entry.publish_time) for entry in told] == [
        (tick * setup.period_ns, tick * setup.period_ns) for tick in (8, 9)
    ]
    marked = [
        store.deserialize_cdr(entry.data, "visualization_msgs/msg/MarkerArray") for entry in told
    ]
    assert [11 in {marker.type for marker in one.markers} for one in marked] == [True, False]


def test_a_paced_run_starts_when_its_earliest_tick_allows() -> None:
    """Delays of single recordings leave the stamps as they are; time that the clock waits shifts them.

    The sampling period is 50 ms, 100 ms by the wall clock.
    """
    ms = 10**6
    for waits, expected_ms in ((False, [1000, 1000, 990, 990]), (True, [1000, 1000, 990, 1095])):
        start = PacedStart(period_ns=50 * ms, speed=0.5, waits=waits)
        starts_ms = []
        for tick, recorded_ms in ((0, 1000), (1, 1199), (2, 1190), (3, 1395)):
            start.note(tick, recorded_ms * ms)
            starts_ms.append(start.stamp_ns(0) // ms)
        assert starts_ms == expected_ms
        assert start.stamp_ns(7) - start.stamp_ns(6) == start.stamps_apart_ns == 100 * ms

    unpaced = PacedStart(period_ns=50 * ms, speed=0.0)
    unpaced.note(3, 1)
    assert unpaced.start_ns is None
    assert unpaced.stamps_apart_ns == 50 * ms


@pytest.mark.parametrize(("scenario", "speed"), [("resilient", 1.0), ("centralized", 0.5)])
def test_plans_are_paths_in_the_time_of_their_stamps(scenario: str, speed: float) -> None:
    """The points of a UAV's plan are those that its agent predicts, as far apart as ticks by the wall clock."""
    run = transport.fly(scenario, phases=PHASES, progress=False)
    setup = Setup.of(run.scenario.validated, "test")
    builder = SceneBuilder.of(setup, run.log)
    start = PacedStart(period_ns=setup.period_ns, speed=speed)
    start.note(0, 1_000_000_000)
    tick = 6
    messages = dict(
        Ros2Messages(builder, start.stamps_apart_ns).scenes(tick, start.stamp_ns(tick), fixed=False)
    )

    predictions = {prediction.agent: prediction for prediction in builder.at(tick).predictions}
    owners = [(agent, k) for agent in setup.agents for k in range(len(setup.owned[agent - 1]))]
    for uav, (agent, k) in enumerate(owners, start=1):
        data = messages[f"/uav{uav}/plan"]
        path: Any = types().deserialize_cdr(data, "nav_msgs/msg/Path")
        points = [[getattr(p.pose.position, axis) for axis in "xyz"] for p in path.poses]
        np.testing.assert_allclose(points, predictions[agent].uavs_I[:, k], atol=ROUNDING)
        stamps = [p.header.stamp.sec * 10**9 + p.header.stamp.nanosec for p in path.poses]
        assert stamps[:3] == [start.stamp_ns(tick + k) for k in range(3)]


@pytest.mark.parametrize("kind", HASHES)
def test_hashes_are_those_of_ros(kind: str) -> None:
    """A topic whose hash differs is another topic for ROS 2."""
    assert types().hash_rihs01(kind) == HASHES[kind]


def test_what_cannot_be_published_is_refused(tmp_path: Path) -> None:
    """No active run: one line, exit code 2."""
    done = command("ros2", "--run", "none", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("transport: no active run in none; name its folder with --run")


def stamped(frame: str, place: tuple[float, float, float]) -> bytes:
    """Return a pose at a place as bytes."""
    header = {"stamp": {"sec": 7, "nanosec": 5}, "frame_id": frame}
    return cdr(
        TARGET_TYPE, {"header": header, "pose": {"position": dict(zip("xyz", place, strict=True))}}
    )


@pytest.mark.parametrize("frame", ["", "inertial", "map"])
def test_a_target_is_read(frame: str) -> None:
    """A pose of any length of its frame's name is read as rosbags writes it.

    In map, z points up and y to the left.
    """
    expected = [1.0, -2.0, 11.0] if frame == "map" else [1.0, 2.0, -11.0]
    assert goal_in(stamped(frame, (1.0, 2.0, -11.0))).tolist() == expected


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"", "expected a PoseStamped"),
        (b"\x00\x02" + stamped("", (0, 0, 0))[2:], "expected a PoseStamped"),
        (stamped("map", (0, 0, 0))[:-8], "expected a PoseStamped"),
        (stamped("map", (0, 0, 0)) + b"\0" * 8, "expected a PoseStamped"),
        (stamped("map", (0, 0, 0))[:12] + b"\xff" * 4, "expected a PoseStamped"),
        (stamped("map", (0, float("nan"), 0)), "finite"),
        (stamped("", (float("inf"), 0, 0)), "finite"),
        (stamped("inertial", (0, 0, -float("inf"))), "finite"),
        (stamped("odom", (0, 0, 0)), "expected the frame inertial or map, got 'odom'"),
        (stamped("x" * 99, (0, 0, 0)), f"got '{'x' * 40}'$"),  # as much of it as fits a line
    ],
)
def test_what_is_no_target_is_refused(data: bytes, problem: str) -> None:
    """Another size or frame and what is not finite is refused in words."""
    with pytest.raises(GoalError, match=problem):
        goal_in(data)
