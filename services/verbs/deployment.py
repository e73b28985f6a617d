"""The verbs of a deployment: router, security, health of a service."""

from pathlib import Path
from typing import Annotated

import typer

from services.verbs.verb import Connect, report_errors, robot_name

Folder = Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of authority and role files.")]


def register(app: typer.Typer) -> None:
    """Add the verbs to the command line."""
    app.command()(router)
    security = typer.Typer(no_args_is_help=True, help="Make and test certificates, passwords and access control.")
    security.command("init")(security_init)
    security.command("check")(security_check)
    security.command("sign")(security_sign)
    app.add_typer(security, name="security")
    app.command()(health)


@report_errors
def router(
    listen: Annotated[
        list[str] | None,
        typer.Option(
            "--listen",
            metavar="ENDPOINT",
            help="Endpoint to listen on, such as tcp/0.0.0.0:7447; if not given that of the role file, or "
            "tcp/127.0.0.1:7447.",
        ),
    ] = None,
    connect: Connect = None,
) -> None:
    """Let clients on other machines reach the robots, until Ctrl-C.

    HAL, model and clients connect with [bold]--connect tcp/HOST:7447[/]. The role file of the router, which `gemuco
    security init` makes, lists the permitted members. Without it the router listens on this machine only, unless
    --listen is given.

    With --connect tcp/OTHER:7447 it is linked with another router.
    """
    from services.process.router import run_router

    run_router(listen or (), connect or ())


@report_errors
def security_init(
    folder: Folder,
    robot: Annotated[
        list[str] | None, typer.Option("--robot", metavar="NAME", help="A robot; repeat for more.")
    ] = None,
    router: Annotated[
        list[str] | None,
        typer.Option(
            "--router",
            metavar="HOST[:PORT]",
            help="Address of the router; repeat for its other names. This machine, port 7447, if not given.",
        ),
    ] = None,
    hal: Annotated[str, typer.Option(metavar="HOST", help="Host of the robots' HAL; this machine if empty.")] = "",
    model: Annotated[str, typer.Option(metavar="HOST", help="Host of the model; that of the HAL if empty.")] = "",
    vision: Annotated[str, typer.Option(metavar="HOST", help="Host of the camera; that of the HAL if empty.")] = "",
    simulator: Annotated[
        str, typer.Option(metavar="HOST", help="Host of a simulated robot; that of the HAL if empty.")
    ] = "",
    days: Annotated[
        int | None, typer.Option(min=1, help="Validity of new certificates \\[days]; 730 if not given.")
    ] = None,
    quic: Annotated[
        bool | None, typer.Option("--quic/--tls", help="Protocol of all links: QUIC, unless UDP is blocked.")
    ] = None,
) -> None:
    """Make certificates, passwords, access control and one role file per process and user.

    A role file is a secret: give it to its process with [bold]--connect hal.NAME.json[/], or to its user.

    Run it again to add robots. To renew a role file, remove it and run again with the folder only. Existing role files
    keep their certificates and passwords.
    """
    from services.security.init import init, placed, planned
    from services.security.report import report
    from services.wire.session import address

    robots = {name: placed(hal or address(name), model, vision, simulator) for name in robot or ()}
    protocol = None if quic is None else "quic" if quic else "tls"
    plan = planned(folder, robots, router or (), protocol, days)
    report(folder, plan, init(folder, plan))


@report_errors
def security_check(
    folder: Folder,
    connect: Annotated[
        str | None,
        typer.Option(
            metavar="ENDPOINT",
            help="Attack the router that runs there instead of one that is started for the test.",
        ),
    ] = None,
) -> int:
    """Attack the security of a folder and report every attack; exit code 1 if one was not refused."""
    from services.security.check import run_check

    return run_check(folder, connect)


@report_errors
def security_sign(
    folder: Folder, model: Annotated[Path, typer.Argument(metavar="MODEL", help="Folder of a trained model.")]
) -> None:
    """Sign a model with the authority's key; a model service with a role file refuses other models."""
    from services.security.signing import sign_model

    sign_model(folder, model)
    typer.echo(f"{model} is signed by the authority of {folder}.")


@report_errors
def health(
    service: Annotated[str, typer.Argument(help="router, hal, model, recorder, simulator or vision.")],
    robot: Annotated[str, typer.Argument(help="A robot's name or file; the router has none.")] = "",
) -> int:
    """Report whether a service of this machine is alive, or which of its loops is stuck.

    Exit code 0 if it is healthy, 1 if not. Containers use [bold]python -m services.health[/], which starts faster.
    """
    from services.errors import ServiceError
    from services.health import ROUTER, check
    from services.wire import keys

    if service not in (ROUTER, *keys.SERVICES):
        raise ServiceError(f"'{service}' is not a service. Known: {ROUTER}, {', '.join(keys.SERVICES)}.")
    if bool(robot) == (service == ROUTER):
        raise ServiceError("The router belongs to no robot." if robot else f"Which robot's '{service}'?")
    is_healthy, text = check(service, robot_name(robot) if robot else "")
    typer.echo(text)
    return 0 if is_healthy else 1
