"""Check signatures of files by the authority whose certificate is in a role file."""

import base64
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from services.errors import ServiceError
from services.wire.connect import authority_certificate, role_file, split_connect

Verify = Callable[[bytes, str], None]


class NotSigned(ServiceError):
    """A model without a signature of the authority, where role files are used."""


def verifier_of(connect: Iterable[str], folder: object) -> Verify | None:
    """Return the check of a model's signature by the authority of the role files; None without a role file.

    Args:
        connect: Endpoints and role files.
        folder: Folder of the model, for the message.

    Raises:
        ServiceError: A role file cannot be read.
    """
    return verifier([role_file(file) for file in split_connect(connect)[1]], folder)


def verifier(configurations: Iterable[Mapping[str, Any]], folder: object) -> Verify | None:
    """Return the check of a signature by the authority in role files, as `verifier_of`."""
    certificates = [text for configured in configurations if (text := authority_certificate(configured))]
    if not certificates:
        return None

    def verify(digest: bytes, signature: str) -> None:
        if not signature:
            raise NotSigned(
                f"The model in '{folder}' is not signed, and this service uses a role file: `gemuco security sign KEYS "
                f"{folder}` signs it with the authority's key."
            )
        if not all(_is_signed(digest, signature, certificate) for certificate in certificates):
            raise NotSigned(
                f"The signature of the model in '{folder}' is not by the authority of the role file, or of another "
                "model. Was the model changed, or signed with the keys of another folder?"
            )

    return verify


def _is_signed(digest: bytes, signature: str, certificate: bytes) -> bool:
    from cryptography import x509
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec

    key = x509.load_pem_x509_certificate(certificate).public_key()
    if not isinstance(key, ec.EllipticCurvePublicKey):
        return False
    try:
        key.verify(base64.b64decode(signature, validate=True), digest, ec.ECDSA(hashes.SHA256()))
    except (InvalidSignature, ValueError):
        return False
    return True
