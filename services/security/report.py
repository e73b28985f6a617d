"""What `gemuco security init` says: what is new, where each file goes, and what to keep away from the network."""

from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path

import typer

from services.security.init import CA_KEY, Done
from services.security.plan import FILE, Plan
from services.wire.connect import role_file
from services.wire.entering import WARN_BEFORE, ending
from services.wire.roles import PEOPLE, ROUTER

VERBS = {"simulator": "simulate", "hal": "hal", "vision": "vision", "model": "serve", "recorder": "record"}


def tell(folder: Path, plan: Plan, done: Done) -> None:
    """Print it."""
    _list("made", done.made)
    for name, parts in done.changed.items():
        typer.echo(f"changed  {name}: {parts}. Copy it again, and restart what uses it.")
    _list("left", done.left)
    known = {f"{name}.json" for name in plan.members()} | {FILE}
    for path in sorted(folder.glob("*.json")):
        if path.name not in known:
            typer.echo(f"unknown  {path.name}: nobody in {FILE} has that name, and no router lets it in. Remove it?")
    if done.made or done.changed:
        for line in _where(folder, plan):
            typer.echo(line)
    for line in _ending(folder, plan):
        typer.secho(line, fg=typer.colors.YELLOW)
    if (folder / CA_KEY).exists():
        typer.secho(
            f"Keep {folder / CA_KEY} offline: whoever has it can be anybody. It is needed to add and to renew, and for "
            "nothing else.",
            fg=typer.colors.YELLOW,
        )
    typer.echo(f"Prove it with: gemuco security check {folder}")


def _list(word: str, names: Iterable[str]) -> None:
    told = ", ".join(names)
    if told:
        typer.echo(f"{word:<8} {told}")


def _where(folder: Path, plan: Plan) -> Iterable[str]:
    """Which file is for which command on which host, and which port must be open there."""
    for name, member in plan.members().items():
        path = folder / f"{name}.json"
        listens = role_file(path).get("listen", {}).get("endpoints", [])
        opened = f"   [{plan.hosts(name)[0]}, listens on {', '.join(listens)}]" if listens else ""
        if name == ROUTER:
            yield f"  gemuco router --connect {path}{opened}"
        elif member.role in PEOPLE:
            yield f"  gemuco top ROBOT --connect {path}   [{member.role}]"
        else:
            yield f"  gemuco {VERBS[member.role]} {member.robots[0]} --connect {path}{opened}"


def _ending(folder: Path, plan: Plan) -> Iterable[str]:
    for name in plan.members():
        until = ending(role_file(folder / f"{name}.json"))
        if until is not None and until - datetime.now(UTC) < WARN_BEFORE:
            yield f"{name}.json ends on {until:%Y-%m-%d}: remove it and run this again to renew it."
