"""Keys of a deployment.

An authority and a certificate for each name. Hosts get their own part by `deploy.folders`.
"""

import ipaddress
import os
import secrets
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import cast

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from transport.deploy.inventory import DeployError
from transport.protocol.network.security import AUTHORITY
from transport.protocol.scenario.files.atomic_writing import write_whole
from transport.protocol.wire.key_expressions import OPERATOR, RECORDER, ROUTER, WATCHER

AUTHORITY_KEY = "ca.key"  # the authority's own, needed to sign further certificates; no host has it
OTHERS = (RECORDER, WATCHER, OPERATOR, ROUTER)  # names with keys besides the processes of a run
LOOPBACK = ("127.0.0.1", "::1", "localhost")  # addresses of a certificate by default
# A certificate is valid from before it was made: clocks of hosts may differ.
_BEFORE = timedelta(days=2)


def make_certificates(folder: Path, addresses: Mapping[str, Sequence[str]], days: int) -> None:
    """Make an authority and, for each name and its addresses, a certificate valid for `days`.

    Keep those that exist.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        # Private keys are not for a repository that the folder may be in.
        ignored = folder / ".gitignore"
        if not ignored.exists():
            write_whole(ignored, "*\n")
        file = folder / AUTHORITY
        if file.exists():
            known = x509.load_pem_x509_certificate(file.read_bytes())
            key = serialization.load_pem_private_key(
                (folder / AUTHORITY_KEY).read_bytes(), password=None
            )
            authority = known, cast(ec.EllipticCurvePrivateKey, key)
        else:
            authority = _issued(file, f"payload-transport authority {secrets.token_hex(4)}", days)
        for name, reached in addresses.items():
            if not (folder / f"{name}.pem").exists():
                _issued(folder / f"{name}.pem", name, days, authority, reached)
    except OSError as error:
        raise DeployError(
            f"--out: cannot use {error.filename or folder} ({error.strerror})"
        ) from error
    except ValueError as error:
        raise DeployError(f"--out: expected an authority in {folder}, got {error}") from error


def _issued(
    file: Path,
    name: str,
    days: int,
    issuer: tuple[x509.Certificate, ec.EllipticCurvePrivateKey] | None = None,
    addresses: Sequence[str] = (),
) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    """Write a new key and its certificate, which an issuer signs, or that of a new authority.

    Return both.
    """
    key, now = ec.generate_private_key(ec.SECP256R1()), datetime.now(UTC)
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer[0].subject if issuer else subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _BEFORE)
        .not_valid_after(now + timedelta(days=days))
        .add_extension(
            x509.BasicConstraints(ca=issuer is None, path_length=None if issuer else 0),
            critical=True,
        )
    )
    if issuer:
        names = x509.SubjectAlternativeName(
            [_general_name(address) for address in dict.fromkeys(addresses)]
        )
        usages = x509.ExtendedKeyUsage(
            [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
        )
        builder = builder.add_extension(names, critical=False).add_extension(usages, critical=False)
    certificate = builder.sign(issuer[1] if issuer else key, hashes.SHA256())
    form, unencrypted = serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    # Only its owner can read the key, from the first byte on.
    with os.fdopen(
        os.open(file.with_suffix(".key"), os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb"
    ) as stream:
        stream.write(key.private_bytes(serialization.Encoding.PEM, form, unencrypted))
    write_whole(file, certificate.public_bytes(serialization.Encoding.PEM))
    return certificate, key


def _general_name(address: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(address))
    except ValueError:
        return x509.DNSName(address)
