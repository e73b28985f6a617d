"""A model service with a role file takes only models that the authority of its role files has signed."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
from arm_model import arm, small_model

from gemuco import checkpoint
from gemuco.errors import CheckpointError
from services.errors import ServiceError
from services.model.living_model import load_model
from services.security.init import CA_KEY, init, placed, planned
from services.security.signing import sign_model
from services.wire.session import address
from services.wire.signature import NotSigned, verifier_of

trained = cache(small_model)


def keys_in(folder: Path) -> tuple[Path, list[str]]:
    """The folder, and what `--connect` of the model is."""
    init(folder, planned(folder, {"a": placed(address("a"))}, ["127.0.0.1"], None, None))
    return folder, ["tcp/127.0.0.1:7447", str(folder / "model.a.json")]


@pytest.fixture
def keys(tmp_path: Path) -> tuple[Path, list[str]]:
    return keys_in(tmp_path / "keys")


@pytest.fixture
def model(tmp_path: Path) -> Path:
    checkpoint.save(trained().with_manifest(number=1), tmp_path / "model")
    return tmp_path / "model"


def load(model: Path, connect: list[str]) -> int:
    return int(load_model(arm(), model, connect).manifest["number"])


def test_without_a_role_file_any_model_is_loaded(model: Path) -> None:
    assert verifier_of(["tcp/127.0.0.1:7447"], model) is None
    assert load(model, []) == 1


def test_unsigned_is_refused_and_signed_is_loaded(keys: tuple[Path, list[str]], model: Path) -> None:
    with pytest.raises(
        NotSigned, match=r"is not signed, and this service uses a role file: `gemuco security sign KEYS"
    ):
        load(model, keys[1])
    sign_model(keys[0], model)
    assert load(model, keys[1]) == 1
    assert load(model, []) == 1
    sign_model(keys[0], model)
    assert load(model, keys[1]) == 1


def test_the_signature_of_another_authority_is_refused(
    keys: tuple[Path, list[str]], model: Path, tmp_path: Path
) -> None:
    stranger, _ = keys_in(tmp_path / "stranger")
    sign_model(stranger, model)
    with pytest.raises(NotSigned, match="is not by the authority of the role file"):
        load(model, keys[1])


@pytest.mark.parametrize("place", ["manifest", "arrays", "signature", "no base64"])
def test_whatever_is_changed_is_refused(place: str, keys: tuple[Path, list[str]], model: Path) -> None:
    sign_model(keys[0], model)
    path = model / checkpoint.MANIFEST
    head = json.loads(path.read_text())
    if place == "manifest":
        head["facts"]["number"] = 2
        head = checkpoint.signed(head)  # its own hash is right again
    elif place == "arrays":
        signature = head["signature"]
        checkpoint.save(replace(trained(), errors={}).with_manifest(number=1), model)
        head = json.loads(path.read_text()) | {"signature": signature}
    else:
        head["signature"] = "AAAA" if place == "signature" else "?"
    path.write_text(json.dumps(head))
    with pytest.raises(NotSigned):
        load(model, keys[1])


def test_a_model_trained_again_is_signed_again_and_the_one_before_keeps_its_signature(
    keys: tuple[Path, list[str]], model: Path
) -> None:
    sign_model(keys[0], model)
    checkpoint.save(trained().with_manifest(number=2), model)
    with pytest.raises(NotSigned, match="is not signed"):
        load(model, keys[1])
    (model / checkpoint.KEPT).rename(model / checkpoint.MANIFEST)
    assert load(model, keys[1]) == 1


def test_signing_needs_the_key_and_a_sound_model(keys: tuple[Path, list[str]], model: Path, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="There is no model"):
        sign_model(keys[0], tmp_path)
    (keys[0] / CA_KEY).unlink()
    with pytest.raises(ServiceError, match=r"Signing needs '.*authority.key' .*offline copy"):
        sign_model(keys[0], model)
