"""The verb `endpoint`: where the services of a robot listen on this machine."""

from typing import Annotated

import typer

from services.verbs.verb import RobotFile, known_robot, report_errors, robot_name


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command()(endpoint)


@report_errors
def endpoint(
    robot: RobotFile,
    service: Annotated[
        str | None, typer.Argument(metavar="[SERVICE]", help="Print only the endpoint of this service, for programs.")
    ] = None,
) -> None:
    """Print where a robot's services listen on this machine: zenoh endpoints for programs in any language.

    They depend on the names of robot and service only, so they are known before the services run. Services started with
    a role file listen where the role file says.
    """
    from services.errors import BadArguments
    from services.runtime import services_here
    from services.wire import keys
    from services.wire.session import endpoint as endpoint_of

    name = robot_name(robot)
    if service is not None:
        if service not in keys.SERVICES:
            raise BadArguments(f"There is no service '{service}'. Services: {', '.join(keys.SERVICES)}.")
        typer.echo(endpoint_of(name, service))
        return
    running = services_here()
    for known in keys.SERVICES:
        state = "running" if (name, known) in running else "not running"
        typer.echo(f"{known:<10} {endpoint_of(name, known):<28} {state}")
    if known_robot(robot) is None and name not in {other for other, _ in running}:
        typer.echo(f"There is no robot file '{name}' here, and no service of it runs. Is the name right?", err=True)
