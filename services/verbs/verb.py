"""What every verb of the command line has: a robot, a plain sentence when something is wrong, an exit code."""

import os
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any

import typer

RobotFile = Annotated[str, typer.Argument(metavar="ROBOT", help="A robot file, or the name of one in robots/.")]
Connect = Annotated[
    list[str] | None,
    typer.Option(
        "--connect",
        metavar="WHERE",
        envvar="GEMUCO_CONNECT",
        help="Where the rest of the robot is: an endpoint (tcp/192.168.0.5:7447), or a role file of `security init`.",
    ),
]

OURS = ("gemuco", "hal", "services", "simulators")
"""A module of these that is missing is a mistake of ours; others may have been left out, as of a small image."""


def speaks_plainly(verb: Callable[..., Any]) -> Callable[..., Any]:
    """Make what we raise on purpose one sentence on stderr: exit code 2 for a wrong robot file, 1 for the rest."""

    @wraps(verb)
    def plain(*arguments: Any, **options: Any) -> Any:
        # numpy reads this when it is first imported: one thread is faster on layers this small.
        for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
            os.environ.setdefault(name, "1")
        from gemuco.errors import SchemaError
        from hal.errors import ConfigError, HalError
        from services.errors import ServiceError

        try:
            code = verb(*arguments, **options)
        except ConfigError as error:
            typer.echo(f"gemuco: {error}", err=True)
            raise typer.Exit(2) from None
        except (SchemaError, HalError, ServiceError) as error:
            typer.echo(f"gemuco: {error}", err=True)
            raise typer.Exit(1) from None
        except ModuleNotFoundError as error:
            if (error.name or "").partition(".")[0] in OURS:
                raise
            typer.echo(f"gemuco: this needs the package '{error.name}', which is not installed here.", err=True)
            raise typer.Exit(1) from None
        except KeyboardInterrupt:
            raise typer.Exit(130) from None
        raise typer.Exit(code or 0)

    return plain


def robot_path(text: str) -> Path:
    """The robot file that is named by its path or by the robot's name."""
    from services.model.artifacts import robot_file

    return robot_file(text)


def load(text: str) -> Any:
    """The robot file, read."""
    from hal.config import load_robot

    return load_robot(robot_path(text))


def robot_name(text: str) -> str:
    """The robot's name; a client needs no robot file."""
    return str(load(text).robot) if Path(text).suffix in (".yaml", ".yml") else text
