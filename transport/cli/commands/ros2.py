"""Command `transport ros2`: publishes an active run for ROS 2, and hands on its targets.

It reads the log of the run as it grows, as the viewer does: no process of the run knows it. A
target becomes the request of `transport target`.
"""

import os
import time
from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import typer
from typer import Option

from transport.cli.active import RunOption, find_active
from transport.cli.output import blame
from transport.flight.active_runs import Commands
from transport.flight.active_runs import read as read_live_run
from transport.log.run_folder import setup_of
from transport.log.run_log import LogTail
from transport.protocol.network.rmw_zenoh import RosNode
from transport.protocol.wire.messages import PlantState
from transport.protocol.wire.names import agent_name
from transport.scene.history import RunHistory
from transport.scene.scene_at_tick import SceneBuilder

if TYPE_CHECKING:
    from transport.report.ros2_bag import Ros2Messages

_LOG = "run.mcap"
# Interval between two looks into the log, s.
_POLL_S = 0.01
# Interval between two looks at the parent of the run, s.
_PARENT_CHECK_S = 0.5
# Interval between two repetitions of the markers that do not change, s.
_FIXED_MARKERS_S = 1.0
# Shortest time between two targets that are handed on, s.
_TARGETS_APART_S = 0.5
_NICE = 10  # the processes of the run have the processors first


def ros2(
    run: RunOption = None,
    connect: str = Option("tcp/127.0.0.1:7447", metavar="ENDPOINT", help="Zenoh router of ROS 2."),
    domain: int = Option(
        0, metavar="NUMBER", min=0, max=232, envvar="ROS_DOMAIN_ID", help="Domain of ROS 2."
    ),
) -> None:
    """Publish an active run for ROS 2 over rmw_zenoh.

    Poses, twists, plans, transforms and markers of payload and UAVs, at every tick, until the run
    ends or is killed. The command reads the log of the run as it grows: no process of the run waits
    for it or knows it. A geometry_msgs/PoseStamped on /target, in the frame inertial or map, sends
    the payload to its position, as transport target does; on /agent2/target only that agent is told.

    Exit codes: 0 the run has ended; 2 no such run; 4 no router; 130 Ctrl-C.

    Example: transport ros2 --connect tcp/127.0.0.1:7447
    """
    from transport.report.ros2_bag import Ros2Messages

    os.nice(_NICE)
    folder, live_run = find_active(run, "name its folder with --run")
    setup = setup_of(folder)
    history = RunHistory(setup)
    tail = LogTail(folder / _LOG, setup)
    start = PacedStart(
        period_ns=setup.period_ns,
        speed=setup.scenario.clock.speed,
        waits=setup.scenario.clock.on_overrun == "hold",
    )
    messages = Ros2Messages(SceneBuilder(setup, history), start.stamps_apart_ns)

    told = {"/target": (), **{f"/{agent_name(agent)}/target": (agent,) for agent in setup.agents}}
    with blame("--connect"):
        node = _node(connect, domain, messages, told)

    commands = Commands(live_run, lambda text, _: typer.echo(text, err=True))
    with closing(node):
        where = f"{len(messages.topics)} topics in domain {domain} through {connect}"
        typer.echo(f"{folder}: {where}", err=True)
        reader = _Reader(
            folder=folder,
            tail=tail,
            history=history,
            start=start,
        )
        targets = _Targets(node=node, commands=commands, told=told)
        _publish(reader, _Publisher(messages=messages, node=node), targets)


def _node(
    connect: str, domain: int, messages: "Ros2Messages", target_topics: Iterable[str]
) -> RosNode:
    """Return a node that publishes the topics of a run and hears targets."""
    from transport.report.ros2_bag import TARGET_TYPE, types

    published = {
        topic: (kind, types().hash_rihs01(kind)) for topic, kind in messages.topics.items()
    }
    target = TARGET_TYPE, types().hash_rihs01(TARGET_TYPE)
    heard = dict.fromkeys(target_topics, target)
    return RosNode(connect, domain, published, heard)


def _publish(reader: "_Reader", publisher: "_Publisher", targets: "_Targets") -> None:
    """Publish the ticks of a run until it has ended, and hand on targets."""
    history = reader.history
    reader.read()
    next_tick = history.last  # begin with the newest tick, not with the whole log
    while True:
        has_ended = reader.read()
        targets.hand_on()

        first = max(next_tick, history.first)
        ticks = [t for t in range(first, history.last + 1) if t in history.plant_states]
        for tick in ticks:
            stamp_ns = reader.start.stamp_ns(tick)
            publisher.publish(tick, stamp_ns, is_newest=tick == ticks[-1])
            next_tick = tick + 1

        if has_ended:
            return
        time.sleep(_POLL_S)


@dataclass(slots=True, kw_only=True)
class PacedStart:
    """Start of a paced run by the wall clock, from the times at which its ticks were recorded.

    A tick is never recorded before its time, so the start is the earliest that any tick allows. The
    time at which this process reads a tick would not do: it is late while the process begins. Where
    the clock waits for late plans (`clock.on_overrun` hold), it goes on later by as much.
    """

    period_ns: int
    speed: float  # scenario time over wall time; 0 for a run that is not paced
    waits: bool = False  # whether the clock waits for late plans
    start_ns: int | None = None

    @property
    def stamps_apart_ns(self) -> int:
        """Time between the stamps of two ticks, ns; without a pace the sampling period."""
        return self.period_ns if self.speed == 0.0 else round(self.period_ns / self.speed)

    def note(self, tick: int, recorded_ns: int) -> None:
        """Note when a tick was recorded, in a paced run."""
        if self.speed == 0.0:
            return
        start_ns = recorded_ns - self._since_start_ns(tick)
        has_waited = self.waits and self._is_a_period_later(start_ns)
        if self.start_ns is None or start_ns < self.start_ns or has_waited:
            self.start_ns = start_ns

    def _is_a_period_later(self, start_ns: int) -> bool:
        """Return whether a tick was recorded later than by the start so far, by a period or more."""
        return self.start_ns is not None and start_ns - self.start_ns >= self.period_ns / self.speed

    def stamp_ns(self, tick: int) -> int:
        """Return the stamp of a tick, ns since 1970; now in a run that is not paced."""
        if self.start_ns is None:
            return time.time_ns()
        return self.start_ns + self._since_start_ns(tick)

    def _since_start_ns(self, tick: int) -> int:
        """Return the wall time from the start to a tick: stamp = start + k T_s / speed."""
        return round(tick * self.period_ns / self.speed)


@dataclass(slots=True, kw_only=True)
class _Reader:
    """Reader of the log of a run as it grows, until the run has ended or its parent was killed."""

    folder: Path
    tail: LogTail
    history: RunHistory
    start: PacedStart
    next_look_s: float = 0.0  # steady-clock time of the next look at the parent
    parent_is_gone: bool = False  # whether the parent, which writes the log, was killed

    def read(self) -> bool:
        """Read new messages; return whether they are the last ones."""
        # Before the messages: all that a killed parent has written is then read.
        if time.monotonic() >= self.next_look_s:
            self.next_look_s = time.monotonic() + _PARENT_CHECK_S
            self.parent_is_gone = read_live_run(self.folder) is None
        recorded = self.tail.read_recorded()
        for entry in recorded:
            if isinstance(entry.message, PlantState):
                self.start.note(entry.message.tick, entry.received_ns)
        self.history.add([entry.message for entry in recorded])
        return self.history.control is not None or self.tail.ended or self.parent_is_gone


@dataclass(slots=True, kw_only=True)
class _Publisher:
    """Publisher of the ticks of a run: the states of all, plans and drawing of the newest."""

    messages: "Ros2Messages"
    node: RosNode
    next_fixed_s: float = 0.0  # steady-clock time of the next markers that do not change

    def publish(self, tick: int, stamp_ns: int, *, is_newest: bool) -> None:
        """Publish a tick with its stamp, ns since 1970."""
        for topic, data in self.messages.states(tick, stamp_ns):
            self.node.put(topic, data)
        if not is_newest:
            return

        is_fixed_due = time.monotonic() >= self.next_fixed_s
        if is_fixed_due:
            self.next_fixed_s = time.monotonic() + _FIXED_MARKERS_S
        for topic, data in self.messages.scenes(tick, stamp_ns, fixed=is_fixed_due):
            self.node.put(topic, data)


@dataclass(slots=True, kw_only=True)
class _Targets:
    """Targets from ROS 2: the newest of a topic in each interval is handed on; a refused one is told."""

    node: RosNode
    commands: Commands
    told: Mapping[str, tuple[int, ...]]  # agents that are told by topic; none for all
    next_s: float = 0.0  # steady-clock time of the next one

    def hand_on(self) -> None:
        """Send the payload to the newest targets, if some have come and the interval is over."""
        from transport.report.ros2_bag import GoalError, goal_in

        if time.monotonic() < self.next_s:
            return
        for topic, agents in self.told.items():
            data = self.node.take(topic)
            if data is None:
                continue

            self.next_s = time.monotonic() + _TARGETS_APART_S
            try:
                self.commands.target(goal_in(data), agents)
            except GoalError as error:
                typer.echo(f"{topic}: {error}", err=True)
