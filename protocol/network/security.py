"""Authentication and access control: the folder of keys, Zenoh's rules from the key expressions.

Keys are the files of certificates and secrets; the names under which Zenoh sends messages are called
key expressions, and the class `Keys` makes them.
"""

import os
import ssl
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from transport.protocol.wire.errors_and_exit_codes import EXIT_SCENARIO, TransportError
from transport.protocol.wire.key_expressions import ACTING, OPERATOR, READING, ROUTER, WATCHER, Keys

AUTHORITY = "ca.pem"  # of a folder of keys; besides it NAME.pem and NAME.key for each name
SHARED = "secret.txt"  # the one secret of a run: a line "user:password", as Zenoh reads it

# All kinds of messages in Zenoh's access control.
_PUBLISHING = ("put", "delete")
_OBSERVING = ("declare_liveliness_subscriber", "liveliness_query")
_ANSWERING = ("declare_queryable", "reply")
_JOINING = ("liveliness_token",)
_ALL = (*_PUBLISHING, *_OBSERVING, *_ANSWERING, *_JOINING, "declare_subscriber", "query")


class SecurityError(TransportError, ValueError):
    """Unusable keys: the text names the file or option, what was expected and what came."""

    exit_code = EXIT_SCENARIO


@dataclass(frozen=True, slots=True)
class Security:
    """The keys of this host and the processes of the run."""

    folder: Path  # certificates made by `transport deploy keys`, or the secret of a run
    names: tuple[str, ...]  # processes that take part: coordinator, plant, agent1, ..., recorder

    @property
    def scheme(self) -> str:
        """Protocol of every endpoint: tls with certificates, tcp with a secret.

        Raises: SecurityError: there is neither.
        """
        for file, scheme in ((AUTHORITY, "tls"), (SHARED, "tcp")):
            if os.access(self.folder / file, os.F_OK):
                return scheme
        expected = f"expected a folder with {AUTHORITY} (transport deploy keys)"
        raise SecurityError(f"network.keys: {expected}, got {self.folder}")

    def check(self, name: str) -> None:
        """Refuse keys that a process cannot use.

        It configures them as if the process joined; the configuration is thrown away.
        Raises: SecurityError: naming the file, expected and got.
        """
        self.configure({"transport": {"link": {}}}, name, "transport/*")

    def configure(self, configuration: dict[str, Any], name: str, prefix: str) -> None:
        """Add security to Zenoh's configuration of a process.

        `prefix` is the beginning of the run's key expressions, or transport/* for all runs.
        Raises: SecurityError: as `check`.
        """
        transport = configuration["transport"]
        if self.scheme == "tcp":
            transport["auth"] = {"usrpwd": self._shared_secret()}
            return

        authority = self.folder / AUTHORITY
        certificate = self.folder / f"{name}.pem"
        key = self.folder / f"{name}.key"
        _check_certificate(name, authority, certificate, key)
        transport["link"]["protocols"] = ["tls"]
        transport["link"]["tls"] = {
            "root_ca_certificate": str(authority),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
            "listen_certificate": str(certificate),
            "listen_private_key": str(key),
            "connect_certificate": str(certificate),
            "connect_private_key": str(key),
        }
        configuration["access_control"] = access_control(self.names, prefix)

    def _shared_secret(self) -> dict[str, str]:
        """Return Zenoh's settings of the one secret of a run. Raises: SecurityError."""
        file = self.folder / SHARED
        try:
            user, password = file.read_text(encoding="utf-8").strip().split(":", 1)
        except (OSError, ValueError) as error:
            expected = f"expected a line USER:SECRET ({error})"
            raise SecurityError(f"network.keys: {file}: {expected}") from error
        return {"user": user, "password": password, "dictionary_file": str(file)}


def _check_certificate(name: str, authority: Path, certificate: Path, key: Path) -> None:
    """Refuse a certificate that peers would refuse, or that is of another process.

    Raises: SecurityError: naming the file, expected and got.
    """
    try:
        named = _shake_hands(authority, certificate, key)
    except FileNotFoundError as error:
        expected = f"the files {certificate} and {key.name}, got only one or none"
        remedy = "transport deploy keys"
        raise SecurityError(f"network.keys: expected {expected} ({remedy})") from error
    except (OSError, ssl.SSLError) as error:
        expected = f"expected a certificate of {authority.name} that is valid now, and its key"
        problem = getattr(error, "verify_message", "") or error
        raise SecurityError(f"network.keys: {certificate}: {expected}, got {problem}") from error
    if named != name:  # the rights are those of the name in the certificate
        expected = f"expected a certificate of {name}, got one of {named or 'no name'}"
        raise SecurityError(f"network.keys: {certificate}: {expected}")


def access_control(names: Sequence[str], prefix: str) -> dict[str, Any]:
    """Return Zenoh's access control: each name has the key expressions of `protocol.wire.key_expressions`.

    Outgoing messages are not checked: the rights of the receiver were checked when it subscribed.
    """
    rules = [_rule("out", "egress", _ALL, [f"{prefix}/**"])]
    policies = []
    subjects = dict.fromkeys([*names, WATCHER, OPERATOR, ROUTER])
    for name in subjects:
        own = [
            _rule(f"{name}.{number}", "ingress", kinds, expressions)
            for number, (kinds, expressions) in enumerate(_rights(Keys.below(prefix), name))
        ]
        rules += own
        policies.append({"rules": ["out", *(rule["id"] for rule in own)], "subjects": [name]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": name, "cert_common_names": [name]} for name in subjects],
        "policies": policies,
    }


def _shake_hands(authority: Path, certificate: Path, key: Path) -> str:
    """Check a certificate as a peer would, by a handshake with itself.

    Returns: The common name in the certificate, empty without one. Raises: ssl.SSLError, OSError.
    """
    there = ssl.MemoryBIO()
    back = ssl.MemoryBIO()
    ends = []
    for protocol, incoming, outgoing in (
        (ssl.PROTOCOL_TLS_CLIENT, back, there),
        (ssl.PROTOCOL_TLS_SERVER, there, back),
    ):
        # Not the default context: from Python 3.13 on it asks for extensions that Zenoh does not.
        context = ssl.SSLContext(protocol)
        context.check_hostname = False  # its address is not known here
        context.verify_mode = ssl.CERT_REQUIRED
        context.load_verify_locations(authority)
        context.load_cert_chain(certificate, key)
        ends.append(
            context.wrap_bio(incoming, outgoing, server_side=protocol == ssl.PROTOCOL_TLS_SERVER)
        )
    # Each end takes a turn for each of its messages: TLS 1.2 needs three, 1.3 with a retry four.
    for end in ends * 4:
        with suppress(ssl.SSLWantReadError):
            end.do_handshake()

    shown = ends[0].getpeercert() or {}
    subject: Any = shown.get("subject", ())
    names = [value for part in subject for kind, value in part if kind == "commonName"]
    return names[0] if names else ""


def _rights(expressions: Keys, name: str) -> Iterator[tuple[Sequence[str], list[str]]]:
    """Yield the rights of a name: kinds of messages of Zenoh's access control, key expressions."""
    if name == ROUTER:
        yield _ALL, [f"{expressions.prefix}/**"]
        return

    observes = name in (WATCHER, OPERATOR)
    yield _OBSERVING, [f"{expressions.prefix}/{kind}/**" for kind in ("alive", "ready")]
    yield (
        ("declare_subscriber",),
        [f"{expressions.prefix}/**"] if observes else expressions.subscriptions(name),
    )
    questions = READING if name != OPERATOR else (*READING, *ACTING)
    yield ("query",), [expressions.request("*", what) for what in questions]
    if observes:
        return

    published = expressions.publications(name)
    if published:
        yield _PUBLISHING, published
    yield _JOINING, [f"{expressions.prefix}/{kind}/{name}/**" for kind in ("alive", "ready")]
    yield _ANSWERING, [expressions.request(name, "*")]


def _rule(
    name: str, flow: str, messages: Sequence[str], expressions: Sequence[str]
) -> dict[str, Any]:
    """Return a rule of Zenoh's access control."""
    return {
        "id": name,
        "permission": "allow",
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": list(expressions),
    }
