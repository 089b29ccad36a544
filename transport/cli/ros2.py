"""The command `transport ros2`: publishes an active run for ROS 2, by the conventions of rmw_zenoh.

It reads the log of the run as it grows, as the viewer does: no process of the run knows it. Its own Zenoh session talks
to a router of ROS 2. Format of keys, tokens and attachments: design document of rmw_zenoh_cpp.
"""

import hashlib
import json
import os
import struct
import time
from contextlib import closing
from itertools import chain
from typing import TYPE_CHECKING, Annotated

import typer
import zenoh
from typer import Option

from protocol.wire.exit_codes import EXIT_INTERRUPTED, EXIT_UNREACHABLE, EXIT_USAGE
from transport.cli.active_run import RunOption, find_active
from transport.cli.output import exit_on, fail
from transport.log.run_folder import setup_of
from transport.log.run_log import LogError
from transport.log.tail import LogTail
from transport.scene.history import KINDS, RunHistory
from transport.scene.scene import SceneBuilder

if TYPE_CHECKING:
    from transport.report.ros2 import Ros2Messages

_LOG, _NODE = "run.mcap", "transport"
_QOS = "::,10:,:,:,,"  # all as by default: reliable, volatile, keep the last 10
# Intervals, s: between two looks into the log, and between two repetitions of the markers that do not change.
_POLL_S, _AGAIN_S = 0.01, 1.0
_NICE = 10  # the processes of the run have the processors first


def mangled(name: str) -> str:
    """Return a name as it stands in a token, in which a slash separates."""
    return name.replace("/", "%") or "%"


class Publisher:
    """One topic of a node of ROS 2.

    Args:
        session: Zenoh session.
        domain: ROS domain.
        topic: Name with its leading slash.
        kind: Type, such as "geometry_msgs/msg/PoseStamped".
        digest: RIHS01 hash of the type.
        number: Of the end point in its node, from 1.
    """

    def __init__(self, session: zenoh.Session, domain: int, topic: str, kind: str, digest: str, number: int) -> None:
        package, name = kind.split("/msg/")
        dds = f"{package}::msg::dds_::{name}_"
        token = f"{node_token(session, domain, number, 'MP')}/{mangled(topic)}/{dds}/{digest}/{_QOS}"
        self._gid = hashlib.sha256(token.encode()).digest()[:16]
        self._count = 0
        self._publisher = session.declare_publisher(f"{domain}/{topic.lstrip('/')}/{dds}/{digest}")
        self._token = session.liveliness().declare_token(token)

    def put(self, data: bytes) -> None:
        """Publish a message; subscribers of ROS 2 drop messages without the attachment."""
        self._count += 1
        attachment = struct.pack("<qqB", self._count, time.time_ns(), len(self._gid)) + self._gid
        self._publisher.put(data, attachment=attachment)


def node_token(session: zenoh.Session, domain: int, number: int, what: str) -> str:
    """Return the token of the node (number 0, "NN"), or the beginning of that of an end point."""
    return f"@ros2_lv/{domain}/{session.info.zid()}/0/{number}/{what}/%/%/{_NODE}"


def ros2(
    run: RunOption = None,
    connect: Annotated[
        str, Option("--connect", metavar="ENDPOINT", help="Zenoh router of ROS 2.")
    ] = "tcp/127.0.0.1:7447",
    domain: Annotated[
        int | None, Option("--domain", metavar="NUMBER", min=0, max=232, help="Default: ROS_DOMAIN_ID, or 0.")
    ] = None,
) -> None:
    """Publish an active run for ROS 2 over rmw_zenoh.

    Poses, twists, plans, transforms and markers of payload and UAVs, at every tick, until the run ends. The command
    reads the log of the run as it grows: no process of the run waits for it or knows it.

    Exit codes: 0 the run has ended; 2 no such run; 4 no router; 130 Ctrl-C.

    Example: transport ros2 --connect tcp/127.0.0.1:7447
    """
    try:
        from transport.report.ros2 import Ros2Messages, types
    except ImportError:
        fail("transport ros2: needs rosbags; pip install 'payload-transport[ros2]'", EXIT_USAGE)
    os.nice(_NICE)
    folder, _ = find_active(run, "name its folder with --run")
    domain = int(os.environ.get("ROS_DOMAIN_ID") or 0) if domain is None else domain
    setup = setup_of(folder)
    history, tail = RunHistory(setup), LogTail(folder / _LOG, KINDS, setup)
    messages = Ros2Messages(SceneBuilder(setup, history))
    try:
        with closing(_open(connect)) as session, exit_on(LogError, code=EXIT_USAGE):
            node = session.liveliness().declare_token(node_token(session, domain, 0, "NN"))
            publishers = {
                topic: Publisher(session, domain, topic, kind, types().hash_rihs01(kind), number)
                for number, (topic, kind) in enumerate(messages.topics().items(), start=1)
            }
            typer.echo(f"{folder}: {len(publishers)} topics in domain {domain} through {connect}", err=True)
            _publish(messages, history, tail, publishers)
            node.undeclare()  # type: ignore[no-untyped-call]
    except KeyboardInterrupt:
        raise typer.Exit(EXIT_INTERRUPTED) from None


def _open(endpoint: str) -> zenoh.Session:
    """Return a session that is a client of the router: between peers, routers of ROS 2 pass on nothing."""
    config = {
        "mode": "client",
        "connect": {"endpoints": [endpoint]},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
    }
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    except zenoh.ZError as error:
        fail(f"--connect: expected a Zenoh router at {endpoint}, got none ({error})", EXIT_UNREACHABLE)


def _publish(messages: "Ros2Messages", history: RunHistory, tail: LogTail, publishers: dict[str, Publisher]) -> None:
    """Publish the ticks of a run until it has ended: the states of all, plans and drawing of the newest."""
    from transport.report.ros2 import cdr

    history.add(tail.read())
    speed, done, again_s, began_ns = messages.speed, history.last - 1, 0.0, 0
    while True:
        history.add(tail.read())
        ticks = [tick for tick in range(max(done + 1, history.first), history.last + 1) if tick in history.plant_states]
        for tick in ticks:
            at_ns = time.time_ns()
            if speed > 0.0:  # stamps of a paced run without the jitter of this process
                since_ns = round(tick * messages.period_ns / speed)
                began_ns = min(began_ns or at_ns, at_ns - since_ns)
                at_ns = began_ns + since_ns
            told = messages.states(tick, at_ns)
            if tick == ticks[-1]:
                fixed = time.monotonic() >= again_s
                again_s = time.monotonic() + _AGAIN_S if fixed else again_s
                told = chain(told, messages.scenes(tick, at_ns, fixed=fixed))
            for topic, kind, message in told:
                publishers[topic].put(cdr(kind, message))
            done = tick
        if history.control is not None or tail.ended:
            return
        time.sleep(_POLL_S)
