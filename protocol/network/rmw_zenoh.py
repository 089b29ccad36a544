"""A node of ROS 2 as a client of a router of rmw_zenoh: keys, liveliness tokens, attachments.

Source: design document of rmw_zenoh_cpp, https://github.com/ros2/rmw_zenoh.
"""

import hashlib
import struct
import time
from collections.abc import Mapping
from functools import partial
from typing import Any

from transport.protocol.network.endpoints import Endpoints
from transport.protocol.network.session import open_session
from transport.protocol.wire.key_expressions import Keys

_NODE = "transport"
_QOS = "::,10:,:,:,,"  # all as by default: reliable, volatile, keep the last 10


class RosNode:
    """Node in one ROS domain.

    Topics to publish and to hear have a type, "sensor_msgs/msg/Imu", and its hash.
    """

    def __init__(
        self,
        router: str,
        domain: int,
        topics: Mapping[str, tuple[str, str]],
        heard: Mapping[str, tuple[str, str]],
    ) -> None:
        self._newest: dict[str, bytes] = {}  # by topic
        self._counts = dict.fromkeys(topics, 0)
        self._gids: dict[str, bytes] = {}
        self._publishers: dict[str, Any] = {}

        endpoints = Endpoints(listen=[], connect=[router], mode="client", security=None)
        self._session = open_session(endpoints, 1.0, _NODE, Keys(_NODE), 5.0)
        self._domain = domain
        self._tokens = self._session.liveliness()
        self._kept: list[Any] = [self._tokens.declare_token(self._token(0, "NN"))]
        for number, (topic, typed) in enumerate(topics.items(), start=1):
            self._publish(number, topic, *typed)
        for number, (topic, typed) in enumerate(heard.items(), start=1 + len(topics)):
            self._subscribe(number, topic, *typed)

    def _publish(self, number: int, topic: str, kind: str, digest: str) -> None:
        """Declare the publisher of a topic, and its token, from which its GID follows."""
        token = f"{self._token(number, 'MP')}/{_end(topic, kind, digest)}"
        self._gids[topic] = hashlib.sha256(token.encode()).digest()[:16]
        self._publishers[topic] = self._session.declare_publisher(self._key(topic, kind, digest))
        self._kept.append(self._tokens.declare_token(token))

    def _subscribe(self, number: int, topic: str, kind: str, digest: str) -> None:
        """Declare the subscriber of a topic, and its token."""
        token = f"{self._token(number, 'MS')}/{_end(topic, kind, digest)}"
        key = self._key(topic, kind, digest)
        receive = partial(self._receive, topic)
        self._kept.append(self._session.declare_subscriber(key, receive))
        self._kept.append(self._tokens.declare_token(token))

    def _key(self, topic: str, kind: str, digest: str) -> str:
        """Return the key of a topic."""
        return f"{self._domain}/{topic[1:]}/{_dds(kind)}/{digest}"

    def _token(self, number: int, what: str) -> str:
        """Return the token of the node (0, "NN"), or the beginning of that of an end point."""
        zid = self._session.info.zid()
        return f"@ros2_lv/{self._domain}/{zid}/0/{number}/{what}/%/%/{_NODE}"

    def put(self, topic: str, data: bytes) -> None:
        """Publish a message in CDR; subscribers drop messages without the attachment."""
        self._counts[topic] += 1
        gid = self._gids[topic]
        attachment = struct.pack("<qqB", self._counts[topic], time.time_ns(), len(gid)) + gid
        self._publishers[topic].put(data, attachment=attachment)

    def take(self, topic: str) -> bytes | None:
        """Return the newest message of a subscribed topic in CDR, once; None without one."""
        return self._newest.pop(topic, None)

    def _receive(self, topic: str, sample: Any) -> None:
        """Keep the newest sample of a topic; on a thread of the session."""
        if sample.attachment is not None:  # otherwise not of ROS 2
            self._newest[topic] = bytes(sample.payload)

    def close(self) -> None:
        """Leave the network; the tokens go with the session."""
        self._session.close()  # type: ignore[no-untyped-call]


def _dds(kind: str) -> str:
    """Return the DDS name of a type, such as "sensor_msgs/msg/Imu"."""
    package, name = kind.split("/msg/")
    return f"{package}::msg::dds_::{name}_"


def _end(topic: str, kind: str, digest: str) -> str:
    """Return the end of the token of an end point."""
    return f"{topic.replace('/', '%')}/{_dds(kind)}/{digest}/{_QOS}"
