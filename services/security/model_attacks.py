"""Attacks on a model service by a model: one without a signature, and one that another authority has signed."""

from collections.abc import Iterator

from services.security.attacks import Attempt, allowed, refused
from services.security.authority import Authority, Identity
from services.security.check_sessions import CheckSessions
from services.security.init import CA, CA_KEY
from services.wire.signature import NotSigned, verifier

DIGEST = b"gemuco security check"


def with_models(sessions: CheckSessions) -> Iterator[Attempt]:
    """Offer models to a service with the role file of the model."""
    configured = sessions.weakened(f"model.{sessions.robot}", "model")
    key = sessions.folder / CA_KEY
    if key.exists():
        own = Authority(Identity((sessions.folder / CA).read_bytes(), key.read_bytes()))
        yield allowed("a model that the authority has signed", _loads(configured, DIGEST, own.signature(DIGEST)))
        of_other = own.signature(DIGEST + b" of another model")
        yield refused("a model with the signature of another one", not _loads(configured, DIGEST, of_other))
    else:
        yield Attempt("a model that the authority has signed", "not tried", f"{CA_KEY} is not here to sign one")
    yield refused("a model without a signature", not _loads(configured, DIGEST, ""))
    foreign = Authority.new().signature(DIGEST)
    yield refused("a model that a foreign authority has signed", not _loads(configured, DIGEST, foreign))


def _loads(configured: dict[str, object], digest: bytes, signature: str) -> bool:
    verify = verifier([configured], "the folder of the model")
    if verify is None:
        return True
    try:
        verify(digest, signature)
    except NotSigned:
        return False
    return True
