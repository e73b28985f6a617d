"""Parts of all verbs of the command line: robot argument, error messages, exit codes."""

import os
import sys
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

RobotFile = Annotated[str, typer.Argument(metavar="ROBOT", help="A robot file, or the name of one in robots/.")]
Connect = Annotated[
    list[str] | None,
    typer.Option(
        "--connect",
        metavar="WHERE",
        envvar="GEMUCO_CONNECT",
        help="Endpoint of the robot's other services (tcp/192.168.0.5:7447), or a role file of `security init`.",
    ),
]

RosRouter = Annotated[
    str | None,
    typer.Option(
        "--ros-router",
        metavar="ENDPOINT",
        help="Router of ROS 2 (rmw_zenohd, or `gemuco router`); that of the robot file, or tcp/127.0.0.1:7447.",
    ),
]
Domain = Annotated[
    int | None, typer.Option(envvar="ROS_DOMAIN_ID", help="Domain of ROS 2; that of the robot file, or 0.")
]
DataBitrate = Annotated[
    int | None,
    typer.Option(min=10_000, help="Bit rate of the data of CAN FD frames \\[bit/s]; classic CAN without it."),
]
Distribution = Annotated[
    str | None,
    typer.Option(
        "--ros-distro",
        envvar="ROS_DISTRO",
        help="ROS distribution of the other nodes: types have no hashes in humble. That of the robot file, or jazzy.",
    ),
]

OURS = ("gemuco", "hal", "services", "simulators")
"""These packages are always installed; others may be missing, as in the small image."""


NO_MEMORY = ("failed to map segment", "Cannot allocate memory", "std::bad_alloc", "can't start new thread")
"""Errors of the loader, the kernel, C++ and Python contain these texts if memory is short."""


class CommandLine(TyperGroup):
    """The command line: an argument that cannot be used is one sentence, as all other errors are."""

    def main(self, *arguments: Any, **options: Any) -> Any:
        """Run a verb; exit with its code, with 2 after an argument that cannot be used."""
        if not options.get("standalone_mode", True):
            return super().main(*arguments, **options)
        options["standalone_mode"] = False
        try:
            code: Any = super().main(*arguments, **options)
        except typer.Abort:
            typer.echo("Aborted.", err=True)
            sys.exit(1)
        except Exception as error:
            message = getattr(error, "format_message", None)  # click's own class, wherever typer has it from
            if message is None:
                raise
            if type(error).__name__ == "NoArgsIsHelpError":
                typer.echo(message(), err=True)
            else:
                text = message().rstrip(".")
                end = " " if text.endswith("?") else ". "
                typer.echo(f"gemuco: {text}{end}{_help_of(getattr(error, 'ctx', None))}", err=True)
            sys.exit(getattr(error, "exit_code", 2))
        sys.exit(code if isinstance(code, int) else 0)


def _help_of(context: Any) -> str:
    """Return a sentence on the help that lists the arguments of a verb."""
    names: list[str] = []
    while context is not None and context.parent is not None:
        names.insert(0, context.info_name)
        context = context.parent
    return f"`{' '.join(['gemuco', *names])} --help` lists what it takes."


def report_errors(verb: Callable[..., Any]) -> Callable[..., Any]:
    """Print an expected error as one sentence on stderr; exit with 2 for a wrong robot file, with 1 otherwise."""

    @wraps(verb)
    def reporting(*arguments: Any, **options: Any) -> Any:
        # numpy reads this at its first import: one thread is faster for such small layers.
        for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
            os.environ.setdefault(name, "1")
        from gemuco.errors import SchemaError
        from hal.errors import ConfigError, HalError
        from services.errors import ServiceError

        try:
            code = verb(*arguments, **options)
        except (SchemaError, HalError, ServiceError) as error:
            typer.echo(f"gemuco: {error}", err=True)
            raise typer.Exit(2 if isinstance(error, ConfigError) else 1) from None
        except ModuleNotFoundError as error:
            if (error.name or "").partition(".")[0] in OURS:
                raise
            from services.extras import sentence

            typer.echo(f"gemuco: {sentence((error.name or '').partition('.')[0])}", err=True)
            raise typer.Exit(1) from None
        except KeyboardInterrupt:
            raise typer.Exit(130) from None
        except (MemoryError, OSError, ImportError, RuntimeError) as error:
            if not _lacks_memory(error):
                raise
            typer.echo(
                "gemuco: there is not enough memory. Is it limited (`ulimit -v`, a container), or do others use it?",
                err=True,
            )
            raise typer.Exit(1) from None
        raise typer.Exit(code or 0)

    return reporting


def _lacks_memory(error: BaseException | None) -> bool:
    """Whether an error, or one that it replaced, is a want of memory; libraries give it several names."""
    while error is not None:
        if isinstance(error, MemoryError) or any(text in str(error) for text in NO_MEMORY):
            return True
        error = error.__cause__ or error.__context__
    return False


def robot_path(text: str) -> Path:
    """Find a robot file by its path or by the name of the robot."""
    from services.model.artifacts import robot_file

    return robot_file(text)


def load(text: str) -> Any:
    """Read a robot file."""
    from hal.config import load_robot

    return load_robot(robot_path(text))


def robot_name(text: str) -> str:
    """Return the name of a robot; a client needs no robot file."""
    return str(load(text).robot) if Path(text).suffix in (".yaml", ".yml") else text


def known_robot(robot: str) -> Any:
    """Return the robot file; None without one, which a client does not need."""
    from hal.config import load_robot
    from hal.errors import ConfigError

    try:
        return load_robot(robot_path(robot))
    except ConfigError:
        return None


def urdf_of(robot: str) -> Path | None:
    """Return the URDF in the robot file; None without a robot file, or if it has none."""
    config = known_robot(robot)
    return None if config is None or config.urdf is None else config.folder / config.urdf
