"""Output of `gemuco security init`: new files, where each file goes, and the key to keep offline."""

from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path

import typer

from services.security.init import CA_KEY, Changes
from services.security.plan import FILE, InstallationPlan
from services.wire.connect import WARN_BEFORE, certificate_end, role_file
from services.wire.member import doors_in
from services.wire.roles import PEOPLE, ROUTER

VERBS = {"simulator": "simulate", "hal": "hal", "vision": "vision", "model": "serve", "recorder": "record"}


def report(folder: Path, plan: InstallationPlan, changes: Changes) -> None:
    """Print the made and changed files, and the next steps."""
    _list("made", changes.made)
    for name, parts in changes.changed.items():
        typer.echo(f"changed  {name}: {parts}. Copy this file again, and restart the programs that use it.")
    _list("left", changes.left)
    known = {f"{name}.json" for name in plan.members()} | {FILE}
    for path in sorted(folder.glob("*.json")):
        if path.name not in known:
            typer.echo(f"unknown  {path.name}: no member of {FILE} has this name, and no router accepts it. Remove it?")
    if changes.made or changes.changed:
        for line in _destinations(folder, plan):
            typer.echo(line)
    for line in _expiring(folder, plan):
        typer.secho(line, fg=typer.colors.YELLOW)
    if (folder / CA_KEY).exists():
        typer.secho(
            f"Keep {folder / CA_KEY} offline: its holder can impersonate every member. The key is only needed "
            "to add and renew members.",
            fg=typer.colors.YELLOW,
        )
    typer.echo(f"Check with: gemuco security check {folder}")


def _list(word: str, names: Iterable[str]) -> None:
    if listed := ", ".join(names):
        typer.echo(f"{word:<8} {listed}")


def _destinations(folder: Path, plan: InstallationPlan) -> Iterable[str]:
    """Yield for each file its command, its host, and the port that must be open there."""
    for name, member in plan.members().items():
        path = folder / f"{name}.json"
        configured = role_file(path)
        listens = [
            *configured.get("listen", {}).get("endpoints", []),
            *(d["listen"] for d in doors_in(configured).values()),
        ]
        place = f"   [{plan.hosts(name)[0]}, listens on {', '.join(listens)}]" if listens else ""
        if name == ROUTER:
            yield f"  gemuco router --connect {path}{place}"
        elif member.role in PEOPLE:
            yield f"  gemuco top ROBOT --connect {path}   [{member.role}]"
        else:
            yield f"  gemuco {VERBS[member.role]} {member.robots[0]} --connect {path}{place}"


def _expiring(folder: Path, plan: InstallationPlan) -> Iterable[str]:
    for name in plan.members():
        until = certificate_end(role_file(folder / f"{name}.json"))
        if until is not None and until - datetime.now(UTC) < WARN_BEFORE:
            yield f"{name}.json ends on {until:%Y-%m-%d}: remove the file and run this command again to renew it."
