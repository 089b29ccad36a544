"""The command `transport ros2`: publishes an active run for ROS 2, and hands on its targets.

It reads the log of the run as it grows, as the viewer does: no process of the run knows it. A target becomes the
request of `transport target`.
"""

import os
import time
from contextlib import closing
from itertools import chain
from typing import TYPE_CHECKING

import typer
from typer import Option

from transport.cli.active import RunOption, find_active
from transport.cli.output import blame
from transport.flight.live import Commands
from transport.log.run_log import LogTail, setup_of
from transport.protocol.network.rmw_zenoh import RosNode
from transport.scene.history import RunHistory
from transport.scene.scene import SceneBuilder

if TYPE_CHECKING:
    from transport.report.ros2 import Ros2Messages

_LOG = "run.mcap"
# Intervals, s: between two looks into the log, and between two repetitions of the markers that do not change.
_POLL_S, _AGAIN_S = 0.01, 1.0
# Shortest time between two targets that are handed on, s.
_INTERVAL_S = 0.5
_NICE = 10  # the processes of the run have the processors first


def ros2(
    run: RunOption = None,
    connect: str = Option("tcp/127.0.0.1:7447", metavar="ENDPOINT", help="Zenoh router of ROS 2."),
    domain: int = Option(
        0, metavar="NUMBER", min=0, max=232, envvar="ROS_DOMAIN_ID", help="Domain of ROS 2."
    ),
) -> None:
    """Publish an active run for ROS 2 over rmw_zenoh.

    Poses, twists, plans, transforms and markers of payload and UAVs, at every tick, until the run ends. The command
    reads the log of the run as it grows: no process of the run waits for it or knows it. A geometry_msgs/PoseStamped
    on /target, in the frame inertial or map, sends the payload to its position, as transport target does.

    Exit codes: 0 the run has ended; 2 no such run; 4 no router; 130 Ctrl-C.

    Example: transport ros2 --connect tcp/127.0.0.1:7447
    """
    from transport.report.ros2 import TARGET, Ros2Messages, types

    os.nice(_NICE)
    folder, there = find_active(run, "name its folder with --run")
    setup = setup_of(folder)
    history, tail = RunHistory(setup), LogTail(folder / _LOG, setup)
    messages = Ros2Messages(SceneBuilder(setup, history))
    kinds = {topic: (kind, types().hash_rihs01(kind)) for topic, kind in messages.topics.items()}
    heard = {TARGET[0]: (TARGET[1], types().hash_rihs01(TARGET[1]))}
    commands = Commands(there, lambda text, _: typer.echo(text, err=True))
    with blame("--connect"):
        node = RosNode(connect, domain, kinds, heard)
    with closing(node):
        typer.echo(f"{folder}: {len(kinds)} topics in domain {domain} through {connect}", err=True)
        _publish(messages, history, tail, node, commands)


def _publish(
    messages: "Ros2Messages", history: RunHistory, tail: LogTail, node: RosNode, commands: Commands
) -> None:
    """Publish the ticks of a run until it has ended: the states of all, plans and drawing of the newest.

    Of the targets that come in each interval the newest is handed on; a refused one is told.
    """
    from transport.report.ros2 import TARGET, GoalError, goal_in

    history.add(tail.read())
    done, again_s, began_ns, next_target_s = history.last - 1, 0.0, 0, 0.0
    while True:
        history.add(tail.read())
        if time.monotonic() >= next_target_s and (data := node.take(TARGET[0])) is not None:
            next_target_s = time.monotonic() + _INTERVAL_S
            try:
                commands.target(goal_in(data))
            except GoalError as error:
                typer.echo(f"{TARGET[0]}: {error}", err=True)
        ticks = [
            tick
            for tick in range(max(done + 1, history.first), history.last + 1)
            if tick in history.plant_states
        ]
        for tick in ticks:
            at_ns = time.time_ns()
            if messages.speed > 0.0:  # stamps of a paced run without the jitter of this process
                since_ns = round(tick * messages.period_ns / messages.speed)
                began_ns = min(began_ns or at_ns, at_ns - since_ns)
                at_ns = began_ns + since_ns
            told = messages.states(tick, at_ns)
            if tick == ticks[-1]:
                fixed = time.monotonic() >= again_s
                again_s = time.monotonic() + _AGAIN_S if fixed else again_s
                told = chain(told, messages.scenes(tick, at_ns, fixed=fixed))
            for topic, data in told:
                node.put(topic, data)
            done = tick
        if history.control is not None or tail.ended:
            return
        time.sleep(_POLL_S)
