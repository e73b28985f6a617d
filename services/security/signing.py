"""Sign a model with the authority's key."""

from pathlib import Path

from gemuco import checkpoint
from services.errors import ServiceError
from services.security.authority import Authority, Identity
from services.security.init import CA, CA_KEY


def sign_model(keys: Path, model: Path) -> None:
    """Sign the model in a folder with the authority's key; a signature before it is replaced.

    Args:
        keys: Folder of `gemuco security init` with the authority's key.
        model: Folder of the model.

    Raises:
        ServiceError: The folder has no key of an authority.
        CheckpointError: The model cannot be loaded.
    """
    try:
        identity = Identity((keys / CA).read_bytes(), (keys / CA_KEY).read_bytes())
    except OSError as error:
        raise ServiceError(
            f"Signing needs '{error.filename}' ({error.strerror}). Put it back from its offline copy, and remove it "
            "again afterwards."
        ) from None
    checkpoint.sign(model, Authority(identity).signature)
