"""Authentication and access control: the folder of keys, and Zenoh's rules made from the table of key expressions.

With certificates every link is TLS, both ends authenticate, and each process admits from a peer only the messages that
the name in its certificate may send. Passwords are for a router alone: a client proves its name to the router, but the
router proves nothing, so in a mesh they could not tell processes apart. A secret is one password for all processes of a
run on one host: it keeps strangers out, and all who have it may send every message.
"""

import ipaddress
import re
import secrets
import ssl
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from protocol.scenario.files import path_problem
from protocol.wire.errors import TransportError
from protocol.wire.exit_codes import EXIT_SCENARIO
from protocol.wire.keys import ACTING, OPERATOR, READING, ROUTER, WATCHER, Keys

# Files of a folder of keys; besides them NAME.pem and NAME.key, or NAME.password, for each name.
AUTHORITY, USERS = "ca.pem", "users.txt"

# File of the one secret of a run: a line "user:password", as Zenoh reads it.
SHARED = "secret.txt"
_SECRET_USER, _SECRET_BYTES = "run", 24

# Messages of a TLS handshake in either direction, at most.
_FLIGHTS = 4

# All kinds of messages in Zenoh's access control.
_PUBLISHING = ("put", "delete")
_OBSERVING = ("declare_liveliness_subscriber", "liveliness_query")
_ALL = (
    *(*_PUBLISHING, *_OBSERVING, "declare_subscriber", "liveliness_token"),
    *("query", "reply", "declare_queryable"),
)


class SecurityError(TransportError, ValueError):
    """Unusable keys: the text names the file or option, what was expected and what came."""

    exit_code = EXIT_SCENARIO


@dataclass(frozen=True, slots=True)
class Security:
    """The keys of this host and the processes of the run."""

    folder: Path  # certificates or passwords made by `transport deploy keys`, or the secret of a run
    names: tuple[str, ...]  # processes that take part: coordinator, plant, agent1, ..., recorder

    @property
    def kind(self) -> Literal["certificates", "passwords", "secret"]:
        """Kind of keys in the folder.

        Raises: SecurityError: there are none.
        """
        problem = path_problem(self.folder)
        if problem:
            raise SecurityError(f"network.keys: cannot read {str(self.folder)!r} ({problem})")
        if (self.folder / AUTHORITY).is_file():
            return "certificates"
        if (self.folder / SHARED).is_file():
            return "secret"
        if (self.folder / USERS).is_file() or next(self.folder.glob("*.password"), None) is not None:
            return "passwords"
        what = "a folder with ca.pem or passwords (transport deploy keys)"
        raise SecurityError(f"network.keys: expected {what}, got {self.folder}")

    @property
    def scheme(self) -> Literal["tls", "tcp"]:
        """Protocol of every endpoint."""
        return "tls" if self.kind == "certificates" else "tcp"

    def check(self, name: str, *, mode: str) -> None:
        """Refuse keys with which a process cannot take part in Zenoh's mode peer, client or router.

        Raises: SecurityError: naming the file, what was expected and what came.
        """
        if self.kind == "secret":
            self._secret()
            return
        if self.kind == "passwords":
            if mode == "peer":
                expected = "expected network.router with passwords, which only a router can check, got a mesh"
                raise SecurityError(f"network.keys: {expected}")
            self._password(name)
            if mode == "router" and not (self.folder / USERS).is_file():
                raise SecurityError(
                    f"network.keys: expected {self.folder / USERS} on the router's host, got no such file"
                )
            return
        authority, certificate, key = self._files(name)
        for file in (authority, certificate, key):
            if not file.is_file():
                raise SecurityError(f"network.keys: expected the file {file}, got none (transport deploy keys)")
        try:
            _shake_hands(authority, certificate, key)
        except (OSError, ssl.SSLError) as error:
            expected = f"expected a certificate of {authority.name} that is valid now, and its key"
            problem = getattr(error, "verify_message", "") or error
            raise SecurityError(f"network.keys: {certificate}: {expected}, got {problem}") from error

    def configuration(self, name: str, prefix: str, *, mode: str) -> dict[str, Any]:
        """Return the security part of Zenoh's configuration of a process; `prefix` is that of its key expressions."""
        self.check(name, mode=mode)
        if self.kind == "secret":
            shared = {"user": _SECRET_USER, "password": self._secret(), "dictionary_file": str(self.folder / SHARED)}
            return {"transport": {"auth": {"usrpwd": shared}}}
        if self.kind == "passwords":
            auth: dict[str, Any] = {"user": name, "password": self._password(name)}
            if mode != "router":
                return {"transport": {"auth": {"usrpwd": auth}}}
            auth["dictionary_file"] = str(self.folder / USERS)
            access = access_control(self.names, prefix, "usernames")
            return {"transport": {"auth": {"usrpwd": auth}}, "access_control": access}
        authority, certificate, key = map(str, self._files(name))
        tls = {
            "root_ca_certificate": authority,
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
            "listen_certificate": certificate,
            "listen_private_key": key,
            "connect_certificate": certificate,
            "connect_private_key": key,
        }
        access = access_control(self.names, prefix, "cert_common_names")
        return {"transport": {"link": {"protocols": ["tls"], "tls": tls}}, "access_control": access}

    def _files(self, name: str) -> tuple[Path, Path, Path]:
        return self.folder / AUTHORITY, self.folder / f"{name}.pem", self.folder / f"{name}.key"

    def _secret(self) -> str:
        file = self.folder / SHARED
        try:
            text, mode = file.read_text(encoding="utf-8"), file.stat().st_mode
        except (OSError, UnicodeDecodeError) as error:
            raise SecurityError(f"network.keys: cannot read {file} ({error})") from error
        _check_is_private(file, mode)
        found = re.fullmatch(rf"{_SECRET_USER}:(\S{{16,}})\n?", text)
        if found is None:
            raise SecurityError(f"network.keys: {file}: expected a line {_SECRET_USER}:SECRET of 16 or more characters")
        return found[1]

    def _password(self, name: str) -> str:
        file = self.folder / f"{name}.password"
        try:
            return file.read_text(encoding="utf-8").strip()
        except OSError as error:
            raise SecurityError(f"network.keys: expected the file {file}, got none ({error.strerror})") from error


def _check_is_private(file: Path, mode: int) -> None:
    """Raise SecurityError if others than the owner of a file can read or write it."""
    if mode & 0o077:
        expected = "expected a file that only its owner can read (chmod 600)"
        raise SecurityError(f"network.keys: {file}: {expected}, got permissions {mode & 0o777:o}")


@contextmanager
def new_secret(folder: Path) -> Iterator[Path]:
    """Make a folder of keys with a random secret, which only this user can read; remove it in the end.

    Raises: SecurityError: the file system keeps no permissions (FAT, some shares). OSError: the folder exists or cannot
        be made.
    """
    folder.mkdir(mode=0o700)
    file = folder / SHARED
    try:
        file.touch(mode=0o600, exist_ok=False)
        _check_is_private(file, file.stat().st_mode)
        file.write_text(f"{_SECRET_USER}:{secrets.token_hex(_SECRET_BYTES)}\n", encoding="utf-8")
        yield folder
    finally:
        with suppress(OSError):
            file.unlink(missing_ok=True)
            folder.rmdir()


def access_control(names: Sequence[str], prefix: str, attribute: str) -> dict[str, Any]:
    """Return Zenoh's access control, which allows each name only the key expressions of `protocol.wire.keys`.

    Incoming messages are checked against their sender's rights. Outgoing ones are not: the receiver's rights were
    checked when it subscribed.

    Args:
        names: Processes that take part; watchers, operators and a router are added.
        prefix: Prefix of the key expressions; its run may be `*` for any.
        attribute: Zenoh's attribute that identifies a peer: cert_common_names or usernames.
    """
    keys = Keys.below(prefix)
    subjects = [*dict.fromkeys([*names, WATCHER, OPERATOR, ROUTER])]
    rules = [_rule("out", "egress", _ALL, [f"{prefix}/**"])]
    policies = []
    for name in subjects:
        own = [_rule(f"{name}.{place}", "ingress", *right) for place, right in enumerate(_rights(keys, name))]
        rules += own
        policies.append({"rules": ["out", *[rule["id"] for rule in own]], "subjects": [name]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": name, attribute: [name]} for name in subjects],
        "policies": policies,
    }


def exposed(endpoints: Sequence[str]) -> str | None:
    """Return the first Zenoh endpoint that is not encrypted and that other hosts can reach, or None."""
    for endpoint in endpoints:
        protocol, _, address = endpoint.partition("/")
        host = address.rpartition(":")[0].strip("[]")
        if protocol in ("tcp", "udp", "ws") and not is_loopback(host):
            return endpoint
    return None


def is_loopback(host: str) -> bool:
    """Return whether only this host can reach an address or host name."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _shake_hands(authority: Path, certificate: Path, key: Path) -> None:
    """Check authority, validity and key of a certificate as a peer would, by a TLS handshake with itself.

    Raises: ssl.SSLError: a peer would refuse it. OSError: a file cannot be read.
    """
    contexts = []
    for protocol in (ssl.PROTOCOL_TLS_SERVER, ssl.PROTOCOL_TLS_CLIENT):
        context = ssl.SSLContext(protocol)
        context.check_hostname = False  # its address is not known here
        context.verify_mode = ssl.CERT_REQUIRED
        context.load_verify_locations(authority)
        context.load_cert_chain(certificate, key)
        contexts.append(context)
    there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = [
        contexts[0].wrap_bio(there, back, server_side=True),
        contexts[1].wrap_bio(back, there, server_side=False),
    ]
    for _ in range(_FLIGHTS):
        for end in ends:
            with suppress(ssl.SSLWantReadError):
                end.do_handshake()


def _rights(keys: Keys, name: str) -> Iterator[tuple[Sequence[str], list[str]]]:
    """Yield the rights of a name: kinds of messages in Zenoh's access control, and key expressions."""
    if name == ROUTER:
        yield _ALL, [f"{keys.prefix}/**"]
        return
    observes = name in (WATCHER, OPERATOR)
    yield _OBSERVING, [f"{keys.prefix}/{kind}/**" for kind in ("alive", "ready")]
    yield ("declare_subscriber",), [f"{keys.prefix}/**"] if observes else keys.subscriptions(name)
    questions = READING if name != OPERATOR else (*READING, *ACTING)
    yield ("query",), [keys.request("*", what) for what in questions]
    if observes:
        return
    published = keys.publications(name)
    if published:
        yield _PUBLISHING, published
    yield ("liveliness_token",), [f"{keys.prefix}/{kind}/{name}/**" for kind in ("alive", "ready")]
    yield ("declare_queryable", "reply"), [keys.request(name, "*")]


def _rule(identity: str, flow: str, messages: Sequence[str], key_exprs: Sequence[str]) -> dict[str, Any]:
    return {
        "id": identity,
        "permission": "allow",
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": list(key_exprs),
    }
