"""The command line of gemuco: all verbs."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from services.verbs import bridges, deployment, describe, endpoint, hardware, init, page, recording
from services.verbs.verb import CommandLine, Connect, RobotFile, load, report_errors, robot_name, robot_path

app = typer.Typer(
    name="gemuco",
    cls=CommandLine,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    help="A body schema for robots, run as a real-time service.\n\n"
    "A robot is a YAML file (robots/musashi_arm.yaml). Three processes run it: [bold]simulate[/] simulates the "
    "hardware, [bold]hal[/] reads and moves it, [bold]serve[/] runs the model. A robot with a camera has a fourth, "
    "[bold]vision[/]. [bold]collect[/] and [bold]train[/] make the model for serve. [bold]demo[/] shows all of this in "
    "a minute.",
)

Seed = Annotated[int, typer.Option(help="Seed of all random numbers.")]
Variant = Annotated[
    str | None,
    typer.Option(help="Variant of the robot to simulate; the first, which is the designer's model, if not given."),
]


def _version(is_given: bool) -> None:
    if is_given:
        from importlib import metadata

        typer.echo(f"gemuco {metadata.version('gemuco')}")
        raise typer.Exit


@app.callback()
def main(
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Log events, not only warnings and errors.")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Set logging on stderr up."""
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
        str | None, typer.Option(help="Condition of the body, such as its tool; the first of the file if not given.")
    ] = None,
    connect: Connect = None,
) -> int:
    """Run simulated nodes on the robot file's buses until Ctrl-C.

    Apply faults while it runs with `gemuco query ROBOT fault "muscle_cut biceps"`.
    """
    from services.hardware.simulator_service import run_simulator

    return run_simulator(load(robot), variant, seed, condition, connect or ())


@app.command()
@report_errors
def hal(robot: RobotFile, connect: Connect = None) -> int:
    """Read and move the hardware until Ctrl-C: publish samples, apply limited commands.

    The motors are off at the start; a client enables them.
    """
    from services.process.realtime import starting

    with starting():
        config = load(robot)
        if config.has_topics:
            from services.ros2.hardware import run_ros_hal as run_hal
        else:
            from services.hardware.hal_service import run_hal
    return run_hal(config, connect or ())


@app.command()
@report_errors
def vision(robot: RobotFile, variant: Variant = None, seed: Seed = 0, connect: Connect = None) -> None:
    """Run the camera of a simulated robot until Ctrl-C: compute the vision signals from the simulator's truth.

    Of a robot with signals of ROS 2 beside a CAN bus: read their topics.

    The camera of a real robot publishes on the same key instead. To cover the simulated one: `gemuco query ROBOT fault
    camera_covered`.
    """
    config = load(robot)
    if any(config.signals[name].source == "ros2" for name in config.seen):
        from services.ros2.vision import run_ros_vision

        return run_ros_vision(config, connect or ())
    from services.hardware.vision_service import run_vision

    return run_vision(config, variant, seed, connect or ())


@app.command()
@report_errors
def serve(
    robot: RobotFile,
    model: Annotated[Path | None, typer.Option(help="The trained model; runs/<robot>/model if not given.")] = None,
    connect: Connect = None,
) -> None:
    """Run the model until Ctrl-C: estimation, control, anomaly detection, online update."""
    from services.process.realtime import starting

    with starting():
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
        typer.Option("--condition", help="Condition of the body to record; repeat for more; all if not given."),
    ] = None,
    samples: Annotated[
        int | None, typer.Option(min=1, help="Samples per condition; the robot file's number if not given.")
    ] = None,
    postures: Annotated[
        Path | None, typer.Option(metavar="CSV", help="Play these taught postures instead of random motion.")
    ] = None,
    bus: Annotated[
        bool,
        typer.Option("--bus", help="Move the robot of a running `gemuco hal` in real time; otherwise no bus is used."),
    ] = False,
    out: Annotated[Path | None, typer.Option(help="The file to write; runs/<robot>/data.npz if not given.")] = None,
) -> None:
    """Record random safe motion or taught postures as training data."""
    from services.learning import collector
    from services.model import artifacts
    from services.show import progress

    config, request = load(robot), collector.Request(tuple(condition or ()), samples, postures)
    with progress("collecting") as report:
        if bus:
            collection = collector.collect_bus(config, seed, request, report)
        else:
            collection = collector.collect_direct(config, variant, seed, request, report)
    path = out or artifacts.data_path(config.robot)
    collection.dataset.save(path)
    typer.echo(
        f"{len(collection.dataset)} samples in {path}: {collection.robot_time:.0f} s of motion in "
        f"{collection.wall_time:.1f} s, {collection.speed:.1f} times real time."
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
            help="Collected samples, runs/<robot>/data.npz if not given; or recordings (.mcap), repeat for more. "
            "With a description of measured data the folder of its files; that of the description if not given."
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the model; runs/<robot>/model if not given.")] = None,
    base: Annotated[
        Path | None,
        typer.Option(
            "--from", help="Fine-tune this model, such as one trained in simulation, on few samples of the robot."
        ),
    ] = None,
    condition: Annotated[
        str | None, typer.Option(help="Condition of the body in these recordings; as recorded if not given.")
    ] = None,
    seed: Seed = 0,
) -> None:
    """Determine the structure of the signals, train, and print the errors in physical units.

    After an interruption (Ctrl-C or kill) the same command continues.
    """
    from services.verbs.train import run_training

    run_training(robot_path(robot), data or (), out, base, seed, condition)


@app.command(context_settings={"ignore_unknown_options": True})  # a target may be negative
@report_errors
def query(
    robot: RobotFile,
    verb: Annotated[str, typer.Argument(help="The verb: estimate, engage, target, adapt, describe, fault, ...")],
    words: Annotated[list[str] | None, typer.Argument(metavar="[WORDS]...", help="Arguments of the verb.")] = None,
    hide: Annotated[
        list[str] | None, typer.Option(help="estimate, anomaly: compute as if this signal were not measured.")
    ] = None,
    watch: Annotated[bool, typer.Option("--watch", help="estimate: repeat once a second until Ctrl-C.")] = False,
    connect: Connect = None,
) -> int:
    """Send a request to a running robot.

    [bold]estimate SIGNAL[/] measured or estimated values    [bold]target SIGNAL V1 V2 ...[/] set a target

    [bold]engage[/], [bold]disengage[/] let the model move the robot or not    [bold]adapt on|off[/] online update

    [bold]move SIGNAL V1 V2 ...[/] move once, with or without a model, and let go

    [bold]control SIGNAL V1 V2 ...[/] command for a target    [bold]simulate V1 V2 ...[/] state after a command

    [bold]anomaly[/] anomaly score    [bold]rollback[/] restore the model before the update

    [bold]normal[/] learn the statistics of normal errors again

    [bold]enable[/], [bold]disable[/], [bold]stop[/], [bold]reset[/], [bold]home DRIVE[/] motors of the HAL

    [bold]tare SENSOR[/] make the present value zero, while the robot is off

    [bold]trust ELEMENT[/], [bold]distrust ELEMENT[/] use an element as measured, or estimate it in its place

    [bold]describe[/] the robot    [bold]describe SERVICE[/] a service    [bold]holder[/] lease holder

    [bold]fault TEXT[/] apply a fault in the simulator
    """
    from services.verbs.ask import ask_robot

    return ask_robot(robot_name(robot), verb, tuple(words or ()), tuple(hide or ()), watch, connect or ())


@app.command()
@report_errors
def estop(
    robot: RobotFile,
    reason: Annotated[str, typer.Option(help="Reported as the cause of the fault.")] = "gemuco estop",
    connect: Connect = None,
) -> int:
    """Stop every drive of a running robot as fast as it can, in any state of the robot.

    Prints the result of each drive. Exit code 1 and an alarm if one did not stop or the HAL did not answer: then cut
    the power. This is not a safety-rated emergency stop.
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
    """Watch all robots, faults first, or one: rates, lateness, ages of signals, estimates, anomaly, motors.

    Without --connect it shows the robots of this machine. With --once the exit code is 0 if all robots are well; for
    one robot, if it is present.
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
    seed: Annotated[int, typer.Option(help="Seed of the simulated actual robot.")] = 1,
    out: Annotated[Path, typer.Option(help="Folder for report, plot, recording and logs.")] = Path("runs/demo"),
    view: Annotated[
        bool, typer.Option("--view", help="Serve the page in the browser meanwhile; its link is printed first.")
    ] = False,
) -> int:
    """Play one minute with a simulated arm: it loses a sensor, learns its own body, and loses a muscle.

    A robot with tools and a camera loses its sight instead, gets another tool, and recognises it.

    Makes a model first if there is none, and starts simulated hardware, HAL and model as processes.
    """
    from services.demo.demo import play

    return play(load(robot), robot_path(robot), seed, out, view)


@app.command()
@report_errors
def reproduce(
    robot: Annotated[str, typer.Argument(metavar="ROBOT", help="Robot of the experiments: pr2, musashi or kxr.")],
    seeds: Annotated[int, typer.Option(min=1, help="Number of runs, each with its own seed.")] = 5,
    out: Annotated[Path, typer.Option(help="Folder for data, models, figures and tables.")] = Path("runs/reproduce"),
    fresh: Annotated[bool, typer.Option("--fresh", help="Collect and train again, also where results exist.")] = False,
) -> None:
    """Run the paper's experiments on a simulated robot; print the paper's figures beside the measured ones."""
    from hal import registry
    from services.show import console, progress

    run = registry.load_object("studies.paper:experiment")(robot)  # by name, because studies are above services
    with progress(f"reproduce {robot}") as report:
        results = run(range(seeds), out / robot, report, fresh)
    results.save(out / robot)
    console().print(results.table())
    typer.echo(f"Figures and tables are in {out / robot}.")


for verbs in (init, describe, hardware, deployment, endpoint, recording, page, bridges):
    verbs.register(app)


if __name__ == "__main__":
    app()
