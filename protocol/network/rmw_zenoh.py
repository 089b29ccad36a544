"""A node of ROS 2 as a client of a router of rmw_zenoh.

Its keys, liveliness tokens and attachments.

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
from transport.protocol.wire.keys import Keys

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
        endpoints = Endpoints(listen=[], connect=[router], mode="client", security=None)
        self._session = open_session(endpoints, 1.0, _NODE, Keys(_NODE), 5.0)
        tokens = self._session.liveliness()
        self._kept: list[Any] = [tokens.declare_token(self._token(domain, 0, "NN"))]
        self._counts = dict.fromkeys(topics, 0)
        self._gids: dict[str, bytes] = {}
        self._publishers: dict[str, Any] = {}
        for number, (topic, (kind, digest)) in enumerate(
            [*topics.items(), *heard.items()], start=1
        ):
            package, name = kind.split("/msg/")
            dds, what = f"{package}::msg::dds_::{name}_", "MP" if topic in topics else "MS"
            token = f"{self._token(domain, number, what)}/{topic.replace('/', '%')}/{dds}/{digest}/{_QOS}"
            key = f"{domain}/{topic[1:]}/{dds}/{digest}"
            if topic in topics:
                self._gids[topic] = hashlib.sha256(token.encode()).digest()[:16]
                self._publishers[topic] = self._session.declare_publisher(key)
            else:
                self._kept.append(
                    self._session.declare_subscriber(key, partial(self._receive, topic))
                )
            self._kept.append(tokens.declare_token(token))

    def _token(self, domain: int, number: int, what: str) -> str:
        """Return the token of the node (number 0, "NN"), or the beginning of that of an end point."""
        return f"@ros2_lv/{domain}/{self._session.info.zid()}/0/{number}/{what}/%/%/{_NODE}"

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
