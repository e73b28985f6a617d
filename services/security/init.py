"""`gemuco security init`: makes what is missing in a folder, and never replaces a certificate or a password."""

import json
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from services.errors import ServiceError
from services.security.authority import Authority, Identity
from services.security.plan import FILE, LISTENING, Plan
from services.security.role_files import Secrets, configuration, secrets_of, text_of, write
from services.wire.connect import role_file

CA_KEY = "authority.key"
CA = "authority.pem"
ALSO_REACHED_AS = ("127.0.0.1", "localhost")
"""In every certificate of who listens, so that it can be tried out on its own machine."""


@dataclass(slots=True)
class Done:
    """What was made, changed and left alone, by file name; for changed ones what is different in them."""

    made: list[str] = field(default_factory=list)
    changed: dict[str, str] = field(default_factory=dict)
    left: list[str] = field(default_factory=list)


def init(folder: Path, plan: Plan) -> Done:
    """Make the authority and the role files that are missing, and bring the others up to the plan.

    Files that exist keep their certificate and password; what depends on other members in them (passwords that they
    know, access control) follows.

    Raises:
        ServiceError: The folder cannot be written, a file in it is not ours, or the authority's key is not there.
    """
    done = Done()
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        authority = _authority(folder, done)
        known = {}
        for name in plan.members():
            path = folder / f"{name}.json"
            if path.exists():
                known[name] = secrets_of(path)
            else:
                known[name] = _new(authority, folder, plan, name)
        for name in plan.members():
            wanted = configuration(plan, name, known, authority.certificate)
            _bring(folder / f"{name}.json", json.loads(text_of(wanted)), done)
        if Plan.read(folder) != plan:
            write(folder / FILE, plan.model_dump_json(indent=1) + "\n", 0o644)
    except OSError as error:
        raise ServiceError(f"'{folder}' cannot be written: {error.strerror} ('{error.filename}').") from None
    return done


def planned(
    folder: Path,
    robots: Mapping[str, Mapping[str, str]],
    routers: Sequence[str],
    protocol: str | None,
    days: int | None,
) -> Plan:
    """The folder's plan, or a new one, with these robots added.

    Raises:
        ServiceError: It contradicts what the folder already has.
    """
    told: dict[str, Any] = {"protocol": protocol, "days": days, "routers": list(routers) or None}
    told = {name: value for name, value in told.items() if value is not None}
    before = Plan.read(folder)
    if before is None:
        if not robots:
            raise ServiceError("A new folder needs at least one --robot NAME.")
        return Plan.of(
            **{"routers": ["127.0.0.1"], **told, "robots": {name: dict(one) for name, one in robots.items()}}
        )
    after = Plan.of(**before.model_dump() | told)
    for name in ("protocol", "routers"):
        if getattr(before, name) != getattr(after, name):
            raise ServiceError(
                f"'{folder}' was made with {name} {_told(getattr(before, name))}, not {_told(getattr(after, name))}: "
                "that is in every role file. Make another folder, or edit plan.json, remove the role files, and run "
                "`gemuco security init` on it again."
            )
    for robot, hosts in robots.items():
        if before.robots.get(robot, hosts) != hosts:
            was = ", ".join(f"{service} at {host}" for service, host in before.robots[robot].items())
            raise ServiceError(
                f"'{folder}' has robot '{robot}' with {was}. To move it, edit plan.json, remove *.{robot}.json, and "
                "run `gemuco security init` on it again."
            )
    return Plan.of(
        **after.model_dump() | {"robots": {**before.robots, **{name: dict(one) for name, one in robots.items()}}}
    )


def placed(hal: str, model: str = "", vision: str = "", simulator: str = "") -> dict[str, str]:
    """Service -> host; all are beside the HAL if nothing else is said."""
    found = {"simulator": simulator or hal, "hal": hal, "vision": vision or hal, "model": model or hal}
    return {service: found[service] for service in LISTENING}


def _told(value: str | list[str]) -> str:
    return value if isinstance(value, str) else ", ".join(value)


@dataclass(frozen=True, slots=True)
class _Found:
    """The authority's certificate, and its key if it is in the folder."""

    certificate: bytes
    key: bytes | None


def _authority(folder: Path, done: Done) -> _Found:
    certificate, key = folder / CA, folder / CA_KEY
    if not certificate.exists() and not key.exists():
        made = Authority.new().identity
        write(key, made.key.decode())
        write(certificate, made.certificate.decode(), 0o644)
        done.made += [CA, CA_KEY]
        return _Found(made.certificate, made.key)
    if not certificate.exists():
        raise ServiceError(f"'{folder}' has {CA_KEY} and no {CA}: bring that one back, or make another folder.")
    done.left.append(CA)
    return _Found(certificate.read_bytes(), key.read_bytes() if key.exists() else None)


def _new(authority: _Found, folder: Path, plan: Plan, name: str) -> Secrets:
    if authority.key is None:
        raise ServiceError(
            f"{name}.json is missing, and to sign a certificate for it needs '{folder / CA_KEY}'. Bring it back from "
            "where it is kept, and take it away again afterwards."
        )
    hosts = plan.hosts(name)
    if hosts:
        hosts = list(dict.fromkeys((*hosts, *ALSO_REACHED_AS)))
    signer = Authority(Identity(authority.certificate, authority.key))
    until = datetime.now(UTC) + timedelta(days=plan.days)
    return Secrets(signer.sign(name, hosts, until), secrets.token_urlsafe(24))


def _bring(path: Path, wanted: dict[str, Any], done: Done) -> None:
    """Write a role file if it is not there or not as it should be; formatting does not count."""
    if not path.exists():
        done.made.append(path.name)
    else:
        before = role_file(path)
        if before == wanted:
            done.left.append(path.name)
            return
        parts = _differing(before, wanted)
        done.changed[path.name] = ", ".join(parts)
    write(path, text_of(wanted))


def _differing(before: Mapping[str, Any], after: Mapping[str, Any], prefix: str = "") -> list[str]:
    """Where two configurations differ, down to the second level, in words that hold no value."""
    found = []
    for name in sorted({*before, *after}):
        one, other = before.get(name), after.get(name)
        if one == other:
            continue
        if isinstance(one, Mapping) and isinstance(other, Mapping) and not prefix:
            found += _differing(one, other, f"{name}.")
        else:
            found.append(f"{prefix}{name}")
    return found
