"""The verbs of the network between machines: the router, and who may enter."""

from pathlib import Path
from typing import Annotated

import typer

from services.verbs.verb import Connect, speaks_plainly

Folder = Annotated[Path, typer.Argument(metavar="FOLDER", help="Where authority and role files are.")]


def register(app: typer.Typer) -> None:
    """Add the verbs to the command line."""
    app.command()(router)
    security = typer.Typer(
        no_args_is_help=True, help="Certificates, passwords and access control: make them, and prove that they hold."
    )
    security.command("init")(security_init)
    security.command("check")(security_check)
    app.add_typer(security, name="security")


@speaks_plainly
def router(
    listen: Annotated[
        list[str] | None,
        typer.Option(
            "--listen",
            metavar="ENDPOINT",
            help="Where to listen, such as tcp/0.0.0.0:7447; those of the role file if not given, else "
            "tcp/127.0.0.1:7447.",
        ),
    ] = None,
    connect: Connect = None,
) -> None:
    """Let clients on other machines reach the robots, until Ctrl-C.

    HAL and model find it with [bold]--connect tcp/HOST:7447[/], and so do clients. Its role file, which `gemuco
    security init` makes, says who may enter; with none it listens on this machine only, unless told to.

    With --connect tcp/OTHER:7447 it exchanges everything with another router.
    """
    from services.process.router import run_router

    run_router(listen or (), connect or ())


@speaks_plainly
def security_init(
    folder: Folder,
    robot: Annotated[list[str] | None, typer.Option("--robot", metavar="NAME", help="A robot; again for more.")] = None,
    router: Annotated[
        list[str] | None,
        typer.Option(
            "--router",
            metavar="HOST[:PORT]",
            help="Where the router is; again for other names that it is reached by. This machine, port 7447, if not "
            "given.",
        ),
    ] = None,
    hal: Annotated[str, typer.Option(metavar="HOST", help="Where the robots' HAL runs; this machine if empty.")] = "",
    model: Annotated[str, typer.Option(metavar="HOST", help="Where the model runs; beside the HAL if empty.")] = "",
    vision: Annotated[str, typer.Option(metavar="HOST", help="Where the camera is; beside the HAL if empty.")] = "",
    simulator: Annotated[
        str, typer.Option(metavar="HOST", help="Where a simulated robot runs; beside the HAL if empty.")
    ] = "",
    days: Annotated[
        int | None, typer.Option(min=1, help="How long new certificates are valid; 730 if not given.")
    ] = None,
    quic: Annotated[
        bool | None, typer.Option("--quic/--tls", help="The protocol of all links: QUIC, unless UDP is blocked.")
    ] = None,
) -> None:
    """Make certificates, passwords, access control and one role file for everybody.

    Each role file is one secret: give it to its process with [bold]--connect hal.NAME.json[/], or to its person.

    Run again to add robots, or with nothing but the folder after removing a role file to renew it; nothing that exists
    gets another certificate or password.
    """
    from services.security.init import init, placed, planned
    from services.security.report import report
    from services.wire.session import address

    robots = {name: placed(hal or address(name), model, vision, simulator) for name in robot or ()}
    protocol = None if quic is None else "quic" if quic else "tls"
    plan = planned(folder, robots, router or (), protocol, days)
    report(folder, plan, init(folder, plan))


@speaks_plainly
def security_check(
    folder: Folder,
    connect: Annotated[
        str | None,
        typer.Option(
            metavar="ENDPOINT",
            help="Attack the router that runs there, in place of one that is started here for it.",
        ),
    ] = None,
) -> int:
    """Try to get in and to do what one must not, and tell what was refused; exit code 1 if anything was not."""
    from services.security.check import run_check

    return run_check(folder, connect)
