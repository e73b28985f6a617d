"""The command line: every verb of gemuco, each ending in a sentence when something is wrong."""

import sys
from importlib import metadata
from pathlib import Path
from typing import Annotated

import typer

from services.verbs import deployment, hardware, page, recording
from services.verbs.verb import Connect, RobotFile, load, report_errors, robot_name, robot_path

app = typer.Typer(
    name="gemuco",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    help="A body schema for robots, run as a real-time service.\n\n"
    "A robot is a YAML file (robots/musashi_arm.yaml). Three processes run it: [bold]simulate[/] pretends to be the "
    "hardware, [bold]hal[/] reads and moves the hardware, [bold]serve[/] thinks; [bold]vision[/] is a fourth where a "
    "camera looks on. [bold]collect[/] and [bold]train[/] make the model that serve needs. [bold]demo[/] does all of "
    "it in a minute.",
)

Seed = Annotated[int, typer.Option(help="Seed of all that is random.")]
Variant = Annotated[
    str | None,
    typer.Option(
        help="Which variant of the robot to simulate; the designer's model, which is the first, if not given."
    ),
]


def _version(is_asked: bool) -> None:
    if is_asked:
        typer.echo(f"gemuco {metadata.version('gemuco')}")
        raise typer.Exit


@app.callback()
def main(
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Log what happens, not only what goes wrong.")
    ] = False,
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Tell it.")] = False,
) -> None:
    """Begin logging on stderr; the verbs do the rest."""
    import logging

    level = logging.INFO if verbose else logging.WARNING
    logging.basicConfig(level=level, stream=sys.stderr, format="%(asctime)s %(levelname)s %(name)s: %(message)s")


@app.command()
@report_errors
def simulate(
    robot: RobotFile,
    variant: Variant = None,
    seed: Seed = 0,
    condition: Annotated[
        str | None, typer.Option(help="Condition of the body, such as its tool; the file's first if not given.")
    ] = None,
    connect: Connect = None,
) -> int:
    """Pretend to be the hardware: simulated CANopen nodes on the robot file's buses, until Ctrl-C.

    Break things while it runs with `gemuco query ROBOT fault "muscle_cut biceps"`.
    """
    from services.hardware.simulator_service import run_simulator

    return run_simulator(load(robot), variant, seed, condition, connect or ())


@app.command()
@report_errors
def hal(robot: RobotFile, connect: Connect = None) -> int:
    """Read the hardware and move it: samples out, limited commands in, until Ctrl-C.

    Starts with the motors off, and turns them on only when asked.
    """
    from services.hardware.hal_service import run_hal

    return run_hal(load(robot), connect or ())


@app.command()
@report_errors
def vision(robot: RobotFile, variant: Variant = None, seed: Seed = 0, connect: Connect = None) -> None:
    """Play the camera of a simulated robot: looks at the simulator's truth, publishes what it sees, until Ctrl-C.

    A real robot's camera publishes on the same key instead. Cover it with `gemuco query ROBOT fault camera_covered`.
    """
    from services.hardware.vision_service import run_vision

    run_vision(load(robot), variant, seed, connect or ())


@app.command()
@report_errors
def serve(
    robot: RobotFile,
    model: Annotated[Path | None, typer.Option(help="The trained model; runs/<robot>/model if not given.")] = None,
    connect: Connect = None,
) -> None:
    """Run the model: estimation, control, anomaly detection and online update, until Ctrl-C."""
    from services.model import artifacts
    from services.model.serve import serve as run_model

    config = load(robot)
    run_model(config, model or artifacts.model_folder(config.robot), connect or ())


@app.command()
@report_errors
def collect(
    robot: RobotFile,
    variant: Variant = None,
    seed: Seed = 0,
    condition: Annotated[
        list[str] | None,
        typer.Option("--condition", help="Condition of the body to record; again for another; all if not given."),
    ] = None,
    samples: Annotated[
        int | None, typer.Option(min=1, help="How many per condition; the robot file's number if not given.")
    ] = None,
    postures: Annotated[
        Path | None, typer.Option(metavar="CSV", help="Play these taught postures in place of random motion.")
    ] = None,
    bus: Annotated[
        bool, typer.Option("--bus", help="Move the robot that `gemuco hal` runs, in its own time; else no bus at all.")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="Where to write; runs/<robot>/data.npz if not given.")] = None,
) -> None:
    """Record random safe motion, or taught postures, to train from."""
    from services.learning import collector
    from services.model import artifacts
    from services.show import progress

    config, request = load(robot), collector.Request(tuple(condition or ()), samples, postures)
    with progress("collecting") as tell:
        if bus:
            found = collector.collect_bus(config, seed, request, tell)
        else:
            found = collector.collect_direct(config, variant, seed, request, tell)
    path = out or artifacts.data_path(config.robot)
    found.dataset.save(path)
    typer.echo(
        f"{len(found.dataset)} samples in {path}: {found.robot_time:.0f} s of motion in {found.wall_time:.1f} s, "
        f"{found.speed:.1f} times real time."
    )


@app.command()
@report_errors
def train(
    robot: Annotated[
        str, typer.Argument(metavar="ROBOT", help="A robot file, its name, or a description of measured data.")
    ],
    data: Annotated[
        list[Path] | None,
        typer.Option(
            help="Collected samples, runs/<robot>/data.npz if not given; or recordings (.mcap), again for another one. "
            "With a description of measured data the folder of its files; that of the description if not given."
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Where to write; runs/<robot>/model if not given.")] = None,
    base: Annotated[
        Path | None,
        typer.Option(
            "--from", help="Fine-tune this model, such as one trained in simulation, on few samples of the robot."
        ),
    ] = None,
    condition: Annotated[
        str | None, typer.Option(help="How the body was in these recordings; as they tell if not given.")
    ] = None,
    seed: Seed = 0,
) -> None:
    """Find out which signals explain which, train, and tell the errors in physical units.

    Interrupted (Ctrl-C, or killed), the same command goes on where it was.
    """
    from services.verbs.train import run_training

    run_training(robot_path(robot), data or (), out, base, seed, condition)


@app.command(context_settings={"ignore_unknown_options": True})  # a target may be negative
@report_errors
def query(
    robot: RobotFile,
    verb: Annotated[str, typer.Argument(help="What to ask: estimate, engage, target, adapt, describe, fault, ...")],
    words: Annotated[list[str] | None, typer.Argument(metavar="[WORDS]...", help="What the verb needs.")] = None,
    hide: Annotated[
        list[str] | None, typer.Option(help="estimate, anomaly: act as if this signal were not measured.")
    ] = None,
    watch: Annotated[bool, typer.Option("--watch", help="estimate: go on once a second until Ctrl-C.")] = False,
    connect: Connect = None,
) -> int:
    """Ask a running robot, from any process.

    [bold]estimate SIGNAL[/] measured or estimated values    [bold]target SIGNAL V1 V2 ...[/] where to go

    [bold]engage[/], [bold]disengage[/] let the model move the robot or not    [bold]adapt on|off[/] online update

    [bold]control SIGNAL V1 V2 ...[/] the command for a target    [bold]simulate V1 V2 ...[/] where a command leads

    [bold]anomaly[/] how unlike normal    [bold]rollback[/] the model before the update

    [bold]normal[/] learn anew what is normal

    [bold]enable[/], [bold]disable[/], [bold]stop[/], [bold]reset[/], [bold]home DRIVE[/] the HAL's motors

    [bold]tare SENSOR[/] what it measures now is zero, while the robot is off

    [bold]describe[/] what the robot is    [bold]describe SERVICE[/] who a service is

    [bold]fault TEXT[/] break something in the simulator
    """
    from services.verbs.ask import ask_robot

    return ask_robot(robot_name(robot), verb, tuple(words or ()), tuple(hide or ()), watch, connect or ())


@app.command()
@report_errors
def estop(
    robot: RobotFile,
    reason: Annotated[str, typer.Option(help="Told as the cause of the fault.")] = "gemuco estop",
    connect: Connect = None,
) -> int:
    """Stop every drive of a running robot as fast as it can, from any process, whatever the robot does.

    Prints what each drive did. Exit code 1 and a loud line if one did not stop or nobody answered: then cut the power.
    This is no safety-rated emergency stop.
    """
    from services.verbs.ask import estop_robot

    return estop_robot(robot_name(robot), reason, connect or ())


@app.command()
@report_errors
def top(
    robot: Annotated[
        str | None, typer.Argument(metavar="[ROBOT]", help="A robot file, or the name of one; all robots if not given.")
    ] = None,
    once: Annotated[bool, typer.Option("--once", help="Print once and exit.")] = False,
    connect: Connect = None,
) -> int:
    """Watch all robots, trouble first, or one: rates, lateness, ages of signals, estimates, anomaly, motors.

    Without --connect those of this machine. With --once the exit code tells: 0 if all robots are well (one: is there).
    """
    if robot is None:
        from services.verbs.fleet_top import watch_fleet

        return watch_fleet(once, connect or ())
    from services.verbs.top import watch

    return watch(robot_name(robot), once, connect or ())


@app.command()
@report_errors
def demo(
    robot: RobotFile = "musashi_arm",
    seed: Annotated[int, typer.Option(help="Which of the actual robots to simulate.")] = 1,
    out: Annotated[Path, typer.Option(help="Where the plot, the recording and the logs go.")] = Path("runs/demo"),
) -> int:
    """One minute with an arm that loses a sensor, learns its own body, and loses a muscle.

    A robot with tools and a camera loses its sight instead, is given another tool, and finds out which.

    Makes a model first if there is none; then starts simulated hardware, HAL and model as processes, and plays.
    """
    from services.demo.demo import play

    return play(load(robot), robot_path(robot), seed, out)


@app.command()
@report_errors
def reproduce(
    robot: Annotated[str, typer.Argument(metavar="ROBOT", help="Whose experiments: pr2, musashi or kxr.")],
    seeds: Annotated[int, typer.Option(min=1, help="How many runs, each with its own seed.")] = 5,
    out: Annotated[Path, typer.Option(help="Where data, models, figures and tables go.")] = Path("runs/reproduce"),
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Collect and train again, even what is there already.")
    ] = False,
) -> None:
    """Run the paper's experiments on a simulated robot and print its figures beside ours."""
    from rich.console import Console

    from hal import registry
    from services.show import progress

    run = registry.load_object("studies.paper:experiment")(robot)  # by name: studies stand above services
    with progress(f"reproduce {robot}") as tell:
        report = run(range(seeds), out / robot, tell, fresh)
    report.save(out / robot)
    Console().print(report.table())
    typer.echo(f"Figures and tables are in {out / robot}.")


for verbs in (hardware, deployment, recording, page):
    verbs.register(app)


if __name__ == "__main__":
    app()
