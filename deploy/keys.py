"""Keys of a deployment: an authority and a certificate for each name, or passwords.

The folder holds all keys and is not copied to hosts; `transport deploy render` gives each host its own part.
"""

import ipaddress
import os
import secrets
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from protocol.network.security import AUTHORITY, USERS
from protocol.wire.errors import TransportError
from protocol.wire.keys import OPERATOR, RECORDER, ROUTER, WATCHER

# The authority's own key, needed to sign further certificates; no host has it.
AUTHORITY_KEY = "ca.key"

# Names with keys besides the processes of a run.
OTHERS = (RECORDER, WATCHER, OPERATOR, ROUTER)

# Addresses of a certificate by default.
LOOPBACK = ("127.0.0.1", "::1", "localhost")

# Clocks of hosts may differ: a certificate is valid from some time before it was made.
_BEFORE = timedelta(days=2)
_PASSWORD_BYTES = 24


class KeysError(TransportError, ValueError):
    """Keys that cannot be made; the text has expected and got."""


def make_certificates(folder: Path, addresses: Mapping[str, Sequence[str]], days: int) -> None:
    """Make an authority, unless there is one, and a certificate for each name that has none.

    Keys are ECDSA on P-256, which every TLS library accepts. Existing files are kept. Addresses are those of the
    process, and host names; new certificates are valid for `days`.

    Raises: KeysError: the folder cannot be written to, or holds half of a pair.
    """
    with _writing(folder):
        authority, key = _authority(folder, days)
        for name, reached in addresses.items():
            file = folder / f"{name}.pem"
            if file.exists():
                continue
            own = ec.generate_private_key(ec.SECP256R1())
            names = [_general_name(address) for address in dict.fromkeys(reached)]
            usages = x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH])
            certificate = (
                _builder(name, authority.subject, own.public_key(), days)
                .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
                .add_extension(x509.SubjectAlternativeName(names), critical=False)
                .add_extension(usages, critical=False)
                .add_extension(_key_usage(signs=False), critical=True)
                .sign(key, hashes.SHA256())
            )
            _write_key(folder / f"{name}.key", own)
            file.write_bytes(certificate.public_bytes(serialization.Encoding.PEM))


def make_passwords(folder: Path, names: Iterable[str]) -> None:
    """Make a password for each name that has none, and the list of passwords for the router.

    Raises: KeysError: the folder cannot be written to.
    """
    with _writing(folder):
        for name in names:
            file = folder / f"{name}.password"
            if not file.exists():
                _write_private(file, f"{secrets.token_urlsafe(_PASSWORD_BYTES)}\n".encode())
        files = sorted(folder.glob("*.password"))
        lines = [f"{file.stem}:{file.read_text(encoding='utf-8').strip()}\n" for file in files]
        (folder / USERS).unlink(missing_ok=True)
        _write_private(folder / USERS, "".join(lines).encode())


def files_of(folder: Path, name: str) -> list[Path]:
    """Return the files of a folder of keys that the host of a name needs.

    Raises: KeysError: a file is missing.
    """
    if (folder / AUTHORITY).exists():
        wanted = [folder / AUTHORITY, folder / f"{name}.pem", folder / f"{name}.key"]
    else:
        wanted = [folder / f"{name}.password", *([folder / USERS] if name == ROUTER else [])]
    for file in wanted:
        if not file.is_file():
            raise KeysError(f"--keys: expected the file {file}, got none (transport deploy keys)")
    return wanted


@contextmanager
def _writing(folder: Path) -> Iterator[None]:
    """Make the folder, and name it in errors of writing to it."""
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        yield
    except OSError as error:
        raise KeysError(f"--out: cannot write {error.filename or folder} ({error.strerror})") from error


def _authority(folder: Path, days: int) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    file, key_file = folder / AUTHORITY, folder / AUTHORITY_KEY
    if file.exists() != key_file.exists():
        present, missing = (file, key_file) if file.exists() else (key_file, file)
        raise KeysError(f"--out: expected {missing.name} beside {present}, got {present.name} alone")
    if file.exists():
        try:
            known = x509.load_pem_x509_certificate(file.read_bytes())
            key = serialization.load_pem_private_key(key_file.read_bytes(), password=None)
        except ValueError as error:
            raise KeysError(f"--out: expected an authority in {file} and {key_file.name}, got {error}") from error
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise KeysError(f"--out: expected an elliptic curve key in {key_file}, got {type(key).__name__}")
        return known, key
    key = ec.generate_private_key(ec.SECP256R1())
    name = f"payload-transport authority {secrets.token_hex(4)}"
    certificate = (
        _builder(name, None, key.public_key(), days)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_key_usage(signs=True), critical=True)
        .sign(key, hashes.SHA256())
    )
    _write_key(key_file, key)
    file.write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    return certificate, key


def _builder(
    name: str, issuer: x509.Name | None, public: ec.EllipticCurvePublicKey, days: int
) -> x509.CertificateBuilder:
    subject, now = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)]), datetime.now(UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject if issuer is None else issuer)
        .public_key(public)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _BEFORE)
        .not_valid_after(now + timedelta(days=days))
    )


def _key_usage(*, signs: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs,
        key_cert_sign=signs,
        crl_sign=signs,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _general_name(address: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(address))
    except ValueError:
        return x509.DNSName(address)


def _write_key(file: Path, key: ec.EllipticCurvePrivateKey) -> None:
    text = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    _write_private(file, text)


def _write_private(file: Path, content: bytes) -> None:
    """Write a file that only its owner can read, from the first byte on."""
    with os.fdopen(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as stream:
        stream.write(content)
