"""The verb `metrics`: running robots for Prometheus."""

from typing import Annotated

import typer

from services.verbs.verb import Connect, report_errors, robot_name


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command()(metrics)


@report_errors
def metrics(
    robots: Annotated[
        list[str] | None, typer.Argument(metavar="[ROBOT]...", help="Robots, each in detail; all robots if not given.")
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port to serve on; 0 for any.")] = 9464,
    host: Annotated[str, typer.Option(help="Address to serve on.")] = "127.0.0.1",
    connect: Connect = None,
) -> None:
    """Serve metrics of running robots for Prometheus: loops, elements, anomaly, buses, troubles.

    Of named robots every element is served; without a name only what the statuses of all robots say.

    Needs the extra packages: pip install 'gemuco[metrics]'.
    """
    from services.metrics.serve import serve_metrics

    serve_metrics([robot_name(robot) for robot in robots or ()], host, port, connect or ())
