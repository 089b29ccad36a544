"""A relay between autopilots and their vehicles, which can fall silent and speaks to an autopilot by itself."""

import select
import socket
import sys
import threading
import time
from types import TracebackType
from typing import Any

from transport.protocol.network.mavlink import messages

_LOCAL = "127.0.0.1"
_LOOK_S = 0.05
_LARGEST = 4096


class Relay:
    """Passes packets on, from `inner` + uav - 1, which autopilots call, to `outer` + uav - 1, and back.

    Attributes:
        silent: UAVs, 1-based, whose links carry nothing now.
        setpoints: For each UAV, of each setpoint that was passed on: the time of its arrival, s of a steady
            clock, and that of the knowledge it is by, s of the run.
    """

    def __init__(self, uavs: int, inner: int, outer: int) -> None:
        self.silent: set[int] = set()
        self.setpoints: dict[int, list[tuple[float, float]]] = {i + 1: [] for i in range(uavs)}
        self._reads = messages().MAVLink(None)
        self._inner = [socket.socket(type=socket.SOCK_DGRAM) for _ in range(uavs)]
        self._outer = [socket.socket(type=socket.SOCK_DGRAM) for _ in range(uavs)]
        self._autopilots: dict[int, Any] = {}  # address by UAV
        for i in range(uavs):
            self._inner[i].bind((_LOCAL, inner + i))
            self._outer[i].bind((_LOCAL, 0))
        self._first = outer
        self._is_over = threading.Event()
        self._switches_s = sys.getswitchinterval()
        self._thread = threading.Thread(target=self._pass_on, daemon=True)

    def __enter__(self) -> "Relay":
        # The test reads logs meanwhile: at each packet the relay would wait 5 ms for the interpreter.
        sys.setswitchinterval(1e-4)
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._is_over.set()
        self._thread.join()
        sys.setswitchinterval(self._switches_s)
        for one in (*self._inner, *self._outer):
            one.close()

    def set_parameter(self, uav: int, name: str, value: float) -> None:
        """Change a parameter of the autopilot of a UAV, also while its link is silent."""
        m = messages()
        sender = m.MAVLink(None, srcSystem=254, srcComponent=190)
        packet = m.MAVLink_param_set_message(uav, 1, name.encode(), value, 9).pack(sender)
        self._inner[uav - 1].sendto(packet, self._autopilots[uav])

    def _pass_on(self) -> None:
        while not self._is_over.is_set():
            there, _, _ = select.select([*self._inner, *self._outer], [], [], _LOOK_S)
            for one in there:
                is_inner = one in self._inner
                i = (self._inner if is_inner else self._outer).index(one)
                try:
                    data, address = one.recvfrom(_LARGEST)
                except ConnectionRefusedError:
                    continue  # the other end is not there yet
                if is_inner:
                    self._autopilots[i + 1] = address
                if i + 1 in self.silent:
                    continue
                if is_inner:
                    self._outer[i].sendto(data, (_LOCAL, self._first + i))
                elif i + 1 in self._autopilots:
                    self._note(i + 1, data)
                    self._inner[i].sendto(data, self._autopilots[i + 1])

    def _note(self, uav: int, data: bytes) -> None:
        """Keep a setpoint of the run that is passed on to the autopilot of a UAV."""
        if int.from_bytes(data[7:10], "little") != messages().MAVLINK_MSG_ID_SET_ATTITUDE_TARGET:
            return
        known_s = self._reads.decode(bytearray(data)).time_boot_ms / 1e3
        self.setpoints[uav].append((time.monotonic(), known_s))
