"""Endpoints of one process: where it listens, and which others it connects to."""

import ipaddress
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

from transport.protocol.network.security import Security, SecurityError

DEFAULT_BASE_PORT = 7447  # of processes started by hand: the first of their consecutive TCP ports


@dataclass(frozen=True, slots=True, kw_only=True)
class Endpoints:
    """Zenoh endpoints of a process, such as "tcp/127.0.0.1:7447"."""

    listen: Sequence[str]  # none for an observer or a client
    connect: Sequence[str]  # each pair of processes is connected once
    mode: Literal["peer", "client", "router"] = "peer"
    security: Security | None = None  # None: every process that can connect may send everything

    def checked(self, name: str, *, insecure: bool) -> "Endpoints":
        """Return these endpoints if a process may use them; `insecure` is that of `network`.

        Raises: SecurityError: unusable keys, or none beyond loopback without `network.insecure`.
        """
        if self.security is not None:
            self._check_scheme(self.security, name)
        open_to_all = first_exposed(self.listen)
        if open_to_all and not insecure:
            expected = (
                "expected a loopback address, or network.keys, or network.insecure = true to be "
                "open to all"
            )
            raise SecurityError(f"network.host: {expected}, got {open_to_all}")
        return self

    def in_words(self) -> str:
        """Return where the process listens and connects to; with a router it does not listen."""
        parts = {"listens on": self.listen, "connects to": self.connect}
        told = [f"{verb} {', '.join(ends)}" for verb, ends in parts.items() if ends]
        return ", ".join(told)

    def _check_scheme(self, security: Security, name: str) -> None:
        """Refuse endpoints without the protocol of the keys. Raises: SecurityError."""
        security.check(name)
        scheme = f"{security.scheme}/"
        for endpoint in (*self.listen, *self.connect):
            if not endpoint.startswith(scheme):
                expected = f"expected {scheme}... with these keys"
                raise SecurityError(f"network.keys: {expected}, got {endpoint}")


def first_exposed(endpoints: Sequence[str]) -> str | None:
    """Return the first endpoint that is not encrypted and that other hosts can reach, or None."""
    for endpoint in endpoints:
        protocol, _, address = endpoint.partition("/")
        host = address.rpartition(":")[0].strip("[]")
        is_local = host == "localhost"
        with suppress(ValueError):  # a name
            is_local = ipaddress.ip_address(host).is_loopback
        if protocol in ("tcp", "udp", "ws") and not is_local:
            return endpoint
    return None
