"""`gemuco demo`: make a model, start all processes, play a story of one minute, and end every process."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from gemuco.warm import warm
from hal.config import RobotConfig, load_robot
from hal.errors import ConfigError
from services.client import Client
from services.demo import arm_story, pace
from services.demo.actor import Actor, Stage
from services.demo.arm_story import ArmStory
from services.demo.pace import CycleCounts
from services.demo.story import MUSCLE, Story
from services.demo.timeline import Timeline
from services.demo.tool_story import ToolStory
from services.errors import AlreadyRunning
from services.extras import engine_of, require
from services.learning import collector, trainer
from services.model import artifacts
from services.model.control_config import ControlConfig
from services.model.living_model import load_model
from services.model.model_config import model_config
from services.process.supervisor import Supervisor, gemuco_command
from services.runtime import services_here
from services.show import progress

READY_WITHIN = 180.0
"""A process must be ready within this time [s], also on a busy machine."""
CLIENT = "remote client"
LEAST_LINES = 20
"""The remote client must have printed this many estimates to count as observed."""


def play(robot: RobotConfig, path: Path, seed: int, out: Path) -> int:
    """Make a missing model, run the processes and play the story; return 0 if all events were observed.

    Args:
        robot: Content of the robot file.
        path: The robot file.
        seed: Seed of the simulated actual robot.
        out: Folder for plot, recording and logs.
    """
    console = Console()
    started = time.monotonic()
    target = control_of(robot).target
    check_start(robot)
    make_model(robot, console)
    with progress("compiling") as report:  # otherwise each process would wait for it
        warm(report)
    with Supervisor(out, at_checks=True) as supervisor:
        with running(robot, path, seed, target, out, supervisor, console) as cast:
            stages = perform(cast.robot, cast.client, target, seed, cast.actor, out / "story.png", console)
        supervisor.stop("client", "recorder")
        cast.remote.print_new()
    ok = summary(stages, cast.actor.stops, cast.remote, out, console)
    if cast.robot.rates != robot.rates:
        console.print(
            f"Played at {cast.robot.rates.hal:g} Hz, because this machine did not keep {robot.rates.hal:g} Hz."
        )
    console.print(f"{time.monotonic() - started:.0f} s in all.")
    return 0 if ok else 1


@dataclass(frozen=True, slots=True)
class Cast:
    """Running robot and its clients, for the story.

    Attributes:
        robot: The robot, with the rates that this machine keeps.
        client: Client of the robot.
        actor: Program that moves the robot.
        remote: Output of a client in a process of its own.
    """

    robot: RobotConfig
    client: Client
    actor: Actor
    remote: "RemoteClient"


@contextmanager
def running(
    robot: RobotConfig, path: Path, seed: int, target: str, out: Path, supervisor: Supervisor, console: Console
) -> Iterator[Cast]:
    """Start the processes; if this machine does not keep their rate, restart them at half of it, at most twice."""
    rates = robot.rates
    for halvings_left in reversed(range(pace.HALVINGS + 1)):
        recording = out / "story.mcap"
        recording.unlink(missing_ok=True)
        with pace.at_rates(path, robot, rates) as file, Client(robot.robot) as client:
            remote = RemoteClient(f"{target} [{robot.signals[target].unit}]", out / "client.log", console)
            start(robot, file, seed, target, recording, supervisor, client, console)

            def idle(remote: RemoteClient = remote) -> None:
                supervisor.check()
                remote.print_new()

            actor = Actor(client, idle, console.print)
            counts = pace.count_cycles(client, actor.wait)
            if not counts.is_kept:
                console.print(too_slow(counts, halvings_left))
            if counts.is_kept or not halvings_left:
                yield Cast(load_robot(file), client, actor, remote)
                return
            supervisor.stop_all()
        rates = pace.halved(rates)


def too_slow(counts: CycleCounts, halvings_left: int) -> str:
    """Return sentences on a rate that is not kept, and on the consequence."""
    consequence = (
        f"All processes are started again at {counts.rate / 2:g} Hz."
        if halvings_left
        else "The story is played in spite of this, and the HAL may stop the robot."
    )
    return f"[yellow]This machine does not keep {counts.rate:g} Hz: {counts}. {consequence}[/]"


def control_of(robot: RobotConfig) -> ControlConfig:
    """Return the settings of control for the story.

    Raises:
        ConfigError: The robot file has no control, or no story fits the robot.
    """
    control = model_config(robot).control
    is_arm = arm_story.fits(robot, control)
    if not (has_tools(robot) or is_arm) and MUSCLE not in robot.signals[robot.command.signal].elements:
        raise ConfigError(
            f"There is no story for '{robot.robot}': it needs a camera and encoders apart from its drives, as files of "
            f"`gemuco init` have, or a camera and conditions, or a muscle {MUSCLE} to cut."
        )
    if control is None:
        raise ConfigError(
            f"The robot file of '{robot.robot}' has no model.control section, so there is nothing to play."
        )
    return control


def has_tools(robot: RobotConfig) -> bool:
    """Whether the robot holds one of several tools and has a camera."""
    return bool(robot.conditions and robot.seen)


def perform(
    robot: RobotConfig, client: Client, target: str, seed: int, actor: Actor, picture: Path, console: Console
) -> list[Stage]:
    """Play and draw the story that fits the robot: tools, or a sensor and a muscle."""
    sizes = robot.signals[target].size, robot.signals[robot.command.signal].size
    if has_tools(robot):
        from services.demo import tool_plot

        schema = load_model(robot, artifacts.model_folder(robot.robot))
        with Timeline(client, target, *sizes, robot.seen) as timeline:
            tool_marks = ToolStory(robot, client, timeline, seed, actor, console.print, schema).play()
        tool_plot.plot(robot, target, schema, timeline, tool_marks, picture)
        return tool_marks.stages
    control = model_config(robot).control
    if control is not None and arm_story.fits(robot, control):
        return _play_arm(robot, client, control, seed, actor, picture, console)
    from services.demo import story_plot

    with Timeline(client, target, *sizes, [target]) as timeline:
        marks = Story(robot, client, timeline, seed, actor, console.print).play()
    story_plot.plot(robot, timeline, marks, picture)
    return marks.stages


def check_start(robot: RobotConfig) -> None:
    """Check, before work that takes minutes, that nothing is missing and no service of this robot runs here.

    Raises:
        MissingExtra: A package for simulation or training is not installed.
        AlreadyRunning: A service of a robot with this name runs on this machine.
    """
    require("torch", "matplotlib", engine_of(robot.physics))
    running = [service for name, service in services_here() if name == robot.robot]
    if running:
        raise AlreadyRunning(
            f"Services of a robot '{robot.robot}' run on this machine: {', '.join(running)}. The demo starts its own; "
            "stop them first, or give the robot in the file another name."
        )


def _play_arm(
    robot: RobotConfig, client: Client, control: ControlConfig, seed: int, actor: Actor, picture: Path, console: Console
) -> list[Stage]:
    from services.demo import arm_plot

    (seen,) = robot.seen
    commands = robot.signals[robot.command.signal].size
    with (
        Timeline(client, control.target, robot.signals[control.target].size, commands, [control.target]) as joints,
        Timeline(client, seen, robot.signals[seen].size, commands, [seen]) as tip,
    ):
        marks = ArmStory(robot, client, joints, tip, control, seed, actor, console.print).play()
    arm_plot.plot(robot, control.target, joints, tip, marks, picture)
    return marks.stages


def make_model(robot: RobotConfig, console: Console) -> None:
    """Collect data and train a model if there is none that fits the robot file."""
    folder = artifacts.model_folder(robot.robot)
    if trainer.fits(robot, folder):
        console.print(f"Using the model in {folder}.")
        return
    console.print("No model yet: the body schema is learned from random motion of the designer's model.")
    with progress("collecting") as report:
        collection = collector.collect_direct(robot, None, 0, progress=report)
    console.print(f"{len(collection.dataset)} samples, {collection.speed:.0f} times faster than real time.")
    with progress("training") as report:
        result = trainer.train(robot, collection.dataset, 0, report)
    trainer.show(result, console)
    trainer.save(result, folder)


def start(
    robot: RobotConfig,
    path: Path,
    seed: int,
    target: str,
    recording: Path,
    supervisor: Supervisor,
    client: Client,
    console: Console,
) -> None:
    """Start the processes, each after the previous one is ready; the last one prints estimates of `target`.

    Raises:
        ChildDied: A process ended.
        NotReady: A process was not ready in time.
    """
    commands = {
        "simulator": ("simulate", str(path), "--variant", "actual", "--seed", str(seed)),
        "hal": ("hal", str(path)),
        **({"vision": ("vision", str(path), "--variant", "actual", "--seed", str(seed))} if robot.seen else {}),
        "model": ("serve", str(path)),
        "recorder": ("record", str(path), str(recording)),
    }
    for name, command in commands.items():
        supervisor.start(name, gemuco_command(*command))
        supervisor.wait_ready(name, _is_running(client, name), READY_WITHIN)
    supervisor.start("client", gemuco_command("query", robot.robot, "estimate", target, "--watch"))
    names = ", ".join(f"{child.name} {child.process.pid}" for child in supervisor.children.values())
    console.print(f"[bold]Processes:[/] {names}")


def _is_running(client: Client, name: str) -> Callable[[], bool]:
    def is_running() -> bool:
        status = client.status(name)
        return status is not None and status.state == "running"

    return is_running


class RemoteClient:
    """Output of the remote client's process."""

    def __init__(self, sign: str, log: Path, console: Console) -> None:
        """Count the lines that contain `sign` as estimates."""
        self._sign, self._log, self._console = sign, log, console
        self._read = 0
        self.lines = 0
        """Number of printed estimates."""
        self.estimated = 0
        """Number of printed estimates that were not measured."""

    def print_new(self) -> None:
        """Print the new complete lines."""
        if not self._log.exists():
            return
        with self._log.open() as log:
            log.seek(self._read)
            text = log.read()
        whole, newline, _ = text.rpartition("\n")
        self._read += len((whole + newline).encode())
        for line in whole.splitlines():
            self.lines += self._sign in line
            self.estimated += "estimated from" in line
            self._console.print(f"    {CLIENT}: {line}", style="dim", highlight=False, markup=False)


def summary(stages: list[Stage], stops: int, remote: RemoteClient, out: Path, console: Console) -> bool:
    """Print a table of the stages; return whether all events were observed."""
    table = Table(title="What happened", title_justify="left", show_lines=True)
    table.add_column("stage")
    table.add_column("measured")
    table.add_column("observed", justify="center")
    for stage in stages:
        table.add_row(stage.name, "\n".join(stage.figures), _yes(stage.observed))
    is_observed = remote.lines >= LEAST_LINES and remote.estimated > 0
    text = f"{remote.lines} estimates printed by a separate process, {remote.estimated} of them not measured"
    table.add_row(CLIENT, text, _yes(is_observed))
    console.print(table)
    if stops:
        console.print(f"The HAL stopped the arm {stops} times by itself, see above.")
    console.print(f"Plot: {out / 'story.png'}   recording: {out / 'story.mcap'}   logs: {out}/*.log")
    return is_observed and all(stage.observed for stage in stages)


def _yes(observed: bool) -> str:
    return "[green]yes[/]" if observed else "[red]no[/]"
