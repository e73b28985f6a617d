"""`gemuco security init`: makes missing files in a folder, and never replaces a certificate or a password."""

import json
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from services.errors import ServiceError
from services.security.authority import Authority, Identity
from services.security.plan import FILE, LISTENING, InstallationPlan
from services.security.role_files import Secrets, configuration, secrets_of, text_of, write
from services.wire.connect import role_file

CA_KEY = "authority.key"
CA = "authority.pem"
ALSO_REACHED_AS = ("127.0.0.1", "localhost")
"""The certificate of every listening member has these names too, so that it can be tested on its own machine."""


@dataclass(slots=True)
class Changes:
    """Names of files that were made, changed (with the changed parts) and left unchanged."""

    made: list[str] = field(default_factory=list)
    changed: dict[str, str] = field(default_factory=dict)
    left: list[str] = field(default_factory=list)


def init(folder: Path, plan: InstallationPlan) -> Changes:
    """Make the authority and the missing role files, and update existing role files to the plan.

    Existing files keep their certificate and password. Entries that depend on other members (passwords, access control)
    are updated.

    Raises:
        ServiceError: The folder cannot be written, it holds a foreign file, or the authority's key is missing.
    """
    changes = Changes()
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        authority = _authority(folder, changes)
        known = {}
        for name in plan.members():
            path = folder / f"{name}.json"
            if path.exists():
                known[name] = secrets_of(path)
            else:
                known[name] = _new(authority, folder, plan, name)
        for name in plan.members():
            configured = configuration(plan, name, known, authority.certificate)
            _update(folder / f"{name}.json", json.loads(text_of(configured)), changes)
        if InstallationPlan.read(folder) != plan:
            write(folder / FILE, plan.model_dump_json(indent=1) + "\n", 0o644)
    except OSError as error:
        raise ServiceError(f"'{folder}' cannot be written: {error.strerror} ('{error.filename}').") from None
    return changes


def planned(
    folder: Path,
    robots: Mapping[str, Mapping[str, str]],
    routers: Sequence[str],
    protocol: str | None,
    days: int | None,
) -> InstallationPlan:
    """Return the folder's plan, or a new one, with these robots added.

    Raises:
        ServiceError: The arguments contradict the folder's plan.
    """
    given: dict[str, Any] = {"protocol": protocol, "days": days, "routers": list(routers) or None}
    given = {name: value for name, value in given.items() if value is not None}
    before = InstallationPlan.read(folder)
    if before is None:
        if not robots:
            raise ServiceError("A new folder needs at least one --robot NAME.")
        return InstallationPlan.of(
            **{"routers": ["127.0.0.1"], **given, "robots": {name: dict(hosts) for name, hosts in robots.items()}}
        )
    after = InstallationPlan.of(**before.model_dump() | given)
    for name in ("protocol", "routers"):
        if getattr(before, name) != getattr(after, name):
            raise ServiceError(
                f"'{folder}' was made with {name} {_listed(getattr(before, name))}, not "
                f"{_listed(getattr(after, name))}, and every role file has this setting. Make another folder, or edit "
                "plan.json, remove the role files, and run `gemuco security init` on the folder again."
            )
    for robot, hosts in robots.items():
        if before.robots.get(robot, hosts) != hosts:
            places = ", ".join(f"{service} at {host}" for service, host in before.robots[robot].items())
            raise ServiceError(
                f"'{folder}' has robot '{robot}' with {places}. To move it, edit plan.json, remove *.{robot}.json, and "
                "run `gemuco security init` on the folder again."
            )
    return InstallationPlan.of(
        **after.model_dump() | {"robots": {**before.robots, **{name: dict(hosts) for name, hosts in robots.items()}}}
    )


def placed(hal: str, model: str = "", vision: str = "", simulator: str = "") -> dict[str, str]:
    """Return the host of each service; a service without a host of its own runs on the HAL's host."""
    hosts = {"simulator": simulator or hal, "hal": hal, "vision": vision or hal, "model": model or hal}
    return {service: hosts[service] for service in LISTENING}


def _listed(value: str | list[str]) -> str:
    return value if isinstance(value, str) else ", ".join(value)


@dataclass(frozen=True, slots=True)
class _FolderAuthority:
    """Certificate of the authority, and its key if the folder holds it."""

    certificate: bytes
    key: bytes | None


def _authority(folder: Path, changes: Changes) -> _FolderAuthority:
    certificate, key = folder / CA, folder / CA_KEY
    is_begun = key.exists() and not any(folder.glob("*.json"))  # a killed `init` left it
    if not certificate.exists() and (is_begun or not key.exists()):
        identity = Authority.new(key=key.read_bytes() if is_begun else None).identity
        write(key, identity.key.decode())
        write(certificate, identity.certificate.decode(), 0o644)
        changes.made += [CA, CA_KEY]
        return _FolderAuthority(identity.certificate, identity.key)
    if not certificate.exists():
        raise ServiceError(f"'{folder}' has {CA_KEY} and no {CA}: put {CA} back, or make another folder.")
    changes.left.append(CA)
    return _FolderAuthority(certificate.read_bytes(), key.read_bytes() if key.exists() else None)


def _new(authority: _FolderAuthority, folder: Path, plan: InstallationPlan, name: str) -> Secrets:
    if authority.key is None:
        raise ServiceError(
            f"{name}.json is missing, and signing a certificate for it needs '{folder / CA_KEY}'. Put the key "
            "back from its offline copy, and remove it again afterwards."
        )
    hosts = plan.hosts(name)
    if hosts:
        hosts = list(dict.fromkeys((*hosts, *ALSO_REACHED_AS)))
    signer = Authority(Identity(authority.certificate, authority.key))
    until = datetime.now(UTC) + timedelta(days=plan.days)
    return Secrets(signer.sign(name, hosts, until), secrets.token_urlsafe(24))


def _update(path: Path, configured: dict[str, Any], changes: Changes) -> None:
    """Write a role file if it is missing or its content differs, apart from formatting."""
    if not path.exists():
        changes.made.append(path.name)
    else:
        before = role_file(path)
        if before == configured:
            changes.left.append(path.name)
            return
        parts = _differing(before, configured)
        changes.changed[path.name] = ", ".join(parts)
    write(path, text_of(configured))


def _differing(before: Mapping[str, Any], after: Mapping[str, Any], prefix: str = "") -> list[str]:
    """Return the names of differing parts, down to the second level; values stay secret."""
    names = []
    for name in sorted({*before, *after}):
        old, new = before.get(name), after.get(name)
        if old == new:
            continue
        if isinstance(old, Mapping) and isinstance(new, Mapping) and not prefix:
            names += _differing(old, new, f"{name}.")
        else:
            names.append(f"{prefix}{name}")
    return names
