"""Keys: signatures, permissions, refusals."""

import ssl
import stat
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec

from transport.deploy.certificates import AUTHORITY_KEY, LOOPBACK, make_certificates
from transport.deploy.inventory import DeployError
from transport.protocol.network.endpoints import first_exposed
from transport.protocol.network.security import AUTHORITY, Security, SecurityError


def certificate(file: Path) -> x509.Certificate:
    """Return a certificate read from its file."""
    return x509.load_pem_x509_certificate(file.read_bytes())


def test_a_certificate_has_name_and_addresses(tmp_path: Path) -> None:
    """A certificate is signed by the authority, names process and addresses, serves both ends, and cannot sign."""
    make_certificates(tmp_path, {"agent1": [*LOOPBACK, "192.0.2.7", "uav.example"]}, days=3)
    own, authority = certificate(tmp_path / "agent1.pem"), certificate(tmp_path / AUTHORITY)
    own.verify_directly_issued_by(authority)
    assert own.subject.rfc4514_string() == "CN=agent1"
    names = own.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert [str(ip) for ip in names.get_values_for_type(x509.IPAddress)] == [
        "127.0.0.1",
        "::1",
        "192.0.2.7",
    ]
    assert names.get_values_for_type(x509.DNSName) == ["localhost", "uav.example"]
    usages = own.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert {usage.dotted_string for usage in usages} == {"1.3.6.1.5.5.7.3.1", "1.3.6.1.5.5.7.3.2"}
    assert not own.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    left = own.not_valid_after_utc - datetime.now(UTC)
    assert timedelta(days=2) < left <= timedelta(days=3)
    assert isinstance(own.public_key(), ec.EllipticCurvePublicKey)


def test_secrets_are_private(tmp_path: Path) -> None:
    """Keys are readable by their owner only."""
    make_certificates(tmp_path, {"plant": LOOPBACK}, days=1)
    secret = [*tmp_path.glob("*.key")]
    assert {file.name for file in secret} == {AUTHORITY_KEY, "plant.key"}
    for file in secret:
        assert stat.S_IMODE(file.stat().st_mode) == 0o600, file


def test_more_keys_later(tmp_path: Path) -> None:
    """Existing keys are kept; new certificates are signed by the same authority."""
    make_certificates(tmp_path, {"agent1": LOOPBACK}, days=1)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    make_certificates(tmp_path, {"agent1": LOOPBACK, "agent2": LOOPBACK}, days=1)
    assert {name: (tmp_path / name).read_bytes() for name in before} == before
    certificate(tmp_path / "agent2.pem").verify_directly_issued_by(
        certificate(tmp_path / AUTHORITY)
    )


def test_half_an_authority_is_refused(tmp_path: Path) -> None:
    """Without the authority's key, or with another file in its place, no certificate is made."""
    make_certificates(tmp_path, {"agent1": LOOPBACK}, days=1)
    (tmp_path / AUTHORITY_KEY).unlink()
    with pytest.raises(DeployError, match=r"cannot use .*ca\.key"):
        make_certificates(tmp_path, {"agent2": LOOPBACK}, days=1)
    (tmp_path / AUTHORITY_KEY).write_text("no key")
    with pytest.raises(DeployError, match="expected an authority in"):
        make_certificates(tmp_path, {"agent2": LOOPBACK}, days=1)
    (tmp_path / "file").write_text("")
    with pytest.raises(DeployError, match="cannot use"):
        make_certificates(tmp_path / "file", {"agent2": LOOPBACK}, days=1)
    assert not (tmp_path / "agent2.pem").exists()


def test_keys_that_cannot_be_used(tmp_path: Path) -> None:
    """A missing folder or certificate and a wrong key are each reported before any process starts."""
    names = ("coordinator", "plant", "agent1")
    with pytest.raises(SecurityError, match=r"expected a folder with ca\.pem"):
        Security(tmp_path, names).check("plant")
    make_certificates(tmp_path, dict.fromkeys(names, LOOPBACK), days=1)
    Security(tmp_path, names).check("plant")
    with pytest.raises(SecurityError, match=r"expected the files .*agent2\.pem and agent2\.key"):
        Security(tmp_path, names).check("agent2")
    other = tmp_path / "other"
    make_certificates(other, {"coordinator": LOOPBACK}, days=1)
    for end in ("pem", "key"):
        (tmp_path / f"coordinator.{end}").write_bytes((other / f"coordinator.{end}").read_bytes())
    with pytest.raises(
        SecurityError,
        match=r"coordinator\.pem: expected a certificate of ca\.pem that is valid now",
    ):
        Security(tmp_path, names).check("coordinator")
    old = tmp_path / "old"
    make_certificates(old, {"agent1": LOOPBACK}, days=-1)
    with pytest.raises(SecurityError, match="certificate has expired"):
        Security(old, names).check("agent1")
    (tmp_path / "plant.key").write_bytes((tmp_path / "agent1.key").read_bytes())
    with pytest.raises(SecurityError, match="and its key"):
        Security(tmp_path, names).check("plant")
    for end in ("pem", "key"):  # valid, but of another process: it would be refused in the run only
        (tmp_path / f"plant.{end}").write_bytes((tmp_path / f"agent1.{end}").read_bytes())
    with pytest.raises(SecurityError, match="expected a certificate of plant, got one of agent1"):
        Security(tmp_path, names).check("plant")


def test_links_with_keys_are_encrypted_and_both_ends_prove_who_they_are(tmp_path: Path) -> None:
    """Zenoh checks the certificate of either end, its name and its time, and refuses what no rule allows."""
    make_certificates(tmp_path, {"plant": LOOPBACK}, days=1)
    found: dict[str, Any] = {"transport": {"link": {}}}
    Security(tmp_path, ("plant",)).configure(found, "plant", "transport/run")
    link = found["transport"]["link"]
    assert link["protocols"] == ["tls"]
    for check in ("enable_mtls", "verify_name_on_connect", "close_link_on_expiration"):
        assert link["tls"][check] is True
    for end in ("listen", "connect"):
        assert link["tls"][f"{end}_certificate"] == str(tmp_path / "plant.pem")
        assert link["tls"][f"{end}_private_key"] == str(tmp_path / "plant.key")
    rules = found["access_control"]
    assert (rules["enabled"], rules["default_permission"]) == (True, "deny")


def test_a_key_of_another_certificate_is_refused(tmp_path: Path) -> None:
    """A key that does not belong to its certificate is refused by TLS as well."""
    make_certificates(tmp_path, dict.fromkeys(("plant", "agent1"), LOOPBACK), days=1)
    (tmp_path / "plant.key").write_bytes((tmp_path / "agent1.key").read_bytes())
    with pytest.raises(ssl.SSLError):
        ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_cert_chain(
            tmp_path / "plant.pem", tmp_path / "plant.key"
        )


@pytest.mark.parametrize(
    ("endpoint", "is_exposed"),
    [
        ("tcp/127.0.0.1:7447", False),
        ("tcp/127.8.9.1:7447", False),
        ("tcp/[::1]:7447", False),
        ("tcp/localhost:7447", False),
        ("tls/0.0.0.0:7447", False),
        ("tcp/0.0.0.0:7447", True),
        ("tcp/[::]:7447", True),
        ("udp/192.0.2.1:7447", True),
        ("tcp/localhost.example:7447", True),
        ("tcp/plant:7447", True),
    ],
)
def test_exposed_endpoints(endpoint: str, is_exposed: bool) -> None:
    """An endpoint without TLS is exposed unless it is this host's own address or name."""
    assert first_exposed([endpoint]) == (endpoint if is_exposed else None)
