"""The verbs of a deployment: is a service healthy?"""

from typing import Annotated

import typer

from services.verbs.verb import speaks_plainly


def register(app: typer.Typer) -> None:
    """Add the verbs to the command line."""
    app.command()(health)


@speaks_plainly
def health(
    service: Annotated[str, typer.Argument(help="router, hal, model, recorder, simulator or vision.")],
    robot: Annotated[str, typer.Argument(help="A robot's name or file; the router has none.")] = "",
) -> int:
    """Tell whether a service of this machine is alive or stuck, and which of its loops is.

    Exit code 0 if it is healthy, 1 if not. Containers ask the same with [bold]python -m services.health[/], which
    starts quicker.
    """
    from services.errors import ServiceError
    from services.health import ROUTER, check
    from services.verbs.verb import robot_name
    from services.wire import keys

    if service not in (ROUTER, *keys.SERVICES):
        raise ServiceError(f"'{service}' is not a service. Known: {ROUTER}, {', '.join(keys.SERVICES)}.")
    if bool(robot) == (service == ROUTER):
        raise ServiceError("The router belongs to no robot." if robot else f"Which robot's '{service}'?")
    is_healthy, text = check(service, robot_name(robot) if robot else "")
    typer.echo(text)
    return 0 if is_healthy else 1
