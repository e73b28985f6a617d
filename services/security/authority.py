"""Private certificate authority, and certificates whose common name is a role."""

import base64
import ipaddress
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Self

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from services.errors import ServiceError

AUTHORITY = "gemuco authority"
AUTHORITY_DAYS = 3650
BACKDATED = timedelta(days=1)
"""Certificates are valid from this long before now, because the clock of a robot that just started may be late."""
_BOTH = x509.ExtendedKeyUsage([ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH])
_CLIENT = x509.ExtendedKeyUsage([ExtendedKeyUsageOID.CLIENT_AUTH])


@dataclass(frozen=True, slots=True)
class Identity:
    """A certificate and its private key, both PEM."""

    certificate: bytes
    key: bytes


@dataclass(frozen=True, slots=True)
class Authority:
    """The signer of certificates; the holder of its key can impersonate every member."""

    identity: Identity

    @classmethod
    def new(cls, days: int = AUTHORITY_DAYS, key: bytes | None = None) -> Self:
        """Make a new authority, with a key of its own if none is given as PEM."""
        signer = ec.generate_private_key(ec.SECP256R1()) if key is None else _private(key)
        name = _name(AUTHORITY)
        usage = x509.KeyUsage(
            digital_signature=True, key_cert_sign=True, crl_sign=True, content_commitment=False, key_encipherment=False,
            data_encipherment=False, key_agreement=False, encipher_only=False, decipher_only=False,
        )  # fmt: skip
        certificate = (
            _builder(name, name, signer.public_key(), datetime.now(UTC) + timedelta(days=days))
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(usage, critical=True)
            .sign(signer, hashes.SHA256())
        )
        return cls(Identity(_pem(certificate), _key_pem(signer)))

    def sign(self, name: str, hosts: Iterable[str], until: datetime) -> Identity:
        """Sign a certificate for a member.

        Args:
            name: Name of the member, such as `hal.musashi_arm`; access control compares this common name.
            hosts: Names and addresses under which others reach the member; empty if it never listens.
            until: End of its validity.
        """
        signer = _private(self.identity.key)
        issuer = x509.load_pem_x509_certificate(self.identity.certificate).subject
        key = ec.generate_private_key(ec.SECP256R1())
        builder = _builder(_name(name), issuer, key.public_key(), until)
        builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        names = [_general_name(host) for host in hosts]
        builder = builder.add_extension(_BOTH if names else _CLIENT, critical=False)
        if names:
            builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
        return Identity(_pem(builder.sign(signer, hashes.SHA256())), _key_pem(key))

    def signature(self, data: bytes) -> str:
        """Return a signature of data, which `services.wire.signature` checks with the certificate."""
        return base64.b64encode(_private(self.identity.key).sign(data, ec.ECDSA(hashes.SHA256()))).decode()


def encoded(pem: bytes) -> str:
    """Return PEM as inline text for zenoh's configuration."""
    return base64.b64encode(pem).decode()


def decoded(text: str) -> bytes:
    """Return the PEM of an inline text; inverse of `encoded`."""
    return base64.b64decode(text)


def _private(key: bytes) -> ec.EllipticCurvePrivateKey:
    loaded = serialization.load_pem_private_key(key, None)
    if not isinstance(loaded, ec.EllipticCurvePrivateKey):
        raise ServiceError("The authority's key was not made by `gemuco security init`.")
    return loaded


def _builder(
    name: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, until: datetime
) -> x509.CertificateBuilder:
    begin = min(datetime.now(UTC), until) - BACKDATED
    return (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(begin)
        .not_valid_after(until)
    )


def _name(text: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host.strip("[]")))
    except ValueError:
        return x509.DNSName(host)


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
