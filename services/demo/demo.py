"""`gemuco demo`: make a model, start all processes, play a story of one minute, and end every process."""

import contextlib
import subprocess
import sys
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from rich.console import Console

from gemuco.compiled.blas import cores
from gemuco.warm import warm
from hal.config import RobotConfig, load_robot
from hal.errors import ConfigError
from hal.robot import open_robot
from services import show
from services.client import Client
from services.demo import pace, report
from services.demo.actor import Actor, NotFollowing, hal_works
from services.demo.live_view import Play, Screen, waiting
from services.demo.page import playing_along
from services.demo.report import CLIENT, Ending
from services.demo.stories.choice import story_of
from services.demo.stories.scene import Scene
from services.errors import AlreadyRunning, ServiceError, ServiceUnavailable
from services.extras import engine_of, require
from services.learning import collector, trainer
from services.model import artifacts
from services.model.control_config import ControlConfig
from services.model.model_config import model_config
from services.process.supervisor import NotReady, Supervisor, gemuco_command
from services.runtime import services_here

AFTER_SIMULATOR = {"hal", "vision"}
"""These processes look for the simulator's buses when they start."""
READY_WITHIN = 180.0
"""A process must be ready within this time [s], also on a busy machine."""


def play(robot: RobotConfig, path: Path, seed: int, out: Path, with_page: bool = False) -> int:
    """Make a missing model, run the processes and play the story; return 0 if all events were observed.

    Args:
        robot: Content of the robot file.
        path: The robot file.
        seed: Seed of the simulated actual robot.
        out: Folder for report, plot, recording and logs.
        with_page: Serve the page in the browser meanwhile; its link is printed first.
    """
    console = show.console()
    started, picture = time.monotonic(), out / "story.png"
    control_of(robot)  # refuses a robot without a story before anything is made
    check_start(robot, with_page)
    with contextlib.ExitStack() as stack:
        link = ""
        if with_page:
            link = stack.enter_context(playing_along(path, out))
            console.print(f"Page: {link}  It shows the robot as soon as its processes run.", soft_wrap=True)
        make_model(robot, console)
        with show.progress("compiling") as advance:  # otherwise each process would wait for it
            warm(advance, has_p=trainer.has_p(robot))
        with Supervisor(out, at_checks=True) as supervisor:
            with running(robot, path, seed, out, supervisor, console, with_page) as cast:
                try:
                    perform(cast, seed, picture, list(supervisor.children), link)
                except ServiceError:
                    report.show(ending_of(cast, robot), console)  # the stages so far
                    raise
            supervisor.stop("client", "recorder")
    ending = ending_of(cast, robot)
    report.show(ending, console)
    report.show_files(out, console)
    report.write(ending, path, seed, picture)
    if ending.rate != ending.wanted:
        console.print(f"Played at {ending.rate:g} Hz, because {ending.wanted:g} Hz are too much for this machine.")
    console.print(f"{time.monotonic() - started:.0f} s in all.")
    return 0 if ending.is_observed else 1


@dataclass(frozen=True, slots=True)
class Cast:
    """Running robot and its clients, for the story.

    Attributes:
        robot: The robot, with the rates that this machine keeps.
        client: Client of the robot.
        actor: Program that moves the robot.
        remote: Output of a client in a process of its own.
        screen: Output of the story.
    """

    robot: RobotConfig
    client: Client
    actor: Actor
    remote: "RemoteClient"
    screen: Screen


def ending_of(cast: Cast, robot: RobotConfig) -> Ending:
    """Return the results of the stages that were played; `robot` has the rates of the robot file."""
    actor, remote = cast.actor, cast.remote
    remote.print_new()
    rates = cast.robot.rates.hal, robot.rates.hal
    return Ending(robot.robot, actor.played, actor.stops, remote.lines, remote.estimated, *rates)


@contextmanager
def running(
    robot: RobotConfig, path: Path, seed: int, out: Path, supervisor: Supervisor, console: Console, with_page: bool
) -> Iterator[Cast]:
    """Start the processes at a rate for this machine; if it is not kept, restart them at half of it."""
    target = story_of(robot).watched(robot, control_of(robot))
    tried = pace.rates_to_try(robot.rates, with_page)
    if tried[0] != robot.rates:
        console.print(
            f"This machine has few processor cores ({cores()}), so the story is played at {tried[0].hal:g} Hz, not at "
            f"{robot.rates.hal:g} Hz."
        )
    for rates in tried:
        is_last = rates is tried[-1]
        recording = out / "story.mcap"
        recording.unlink(missing_ok=True)
        with pace.at_rates(path, robot, rates) as file, Client(robot.robot) as client:
            screen = Screen(console)
            remote = RemoteClient(f"{target} [{robot.signals[target].unit}]", out / "client.log", console)
            start(robot, file, seed, target, recording, supervisor, client, console)

            def idle(remote: RemoteClient = remote, screen: Screen = screen) -> None:
                supervisor.check()
                remote.print_new()
                screen.turn()

            actor = Actor(client, idle, screen.report)
            with waiting(console, f"counting whether this machine keeps {rates.hal:g} Hz"):
                reason = too_slow(client, actor, is_last)
            if reason:
                consequence = (
                    "The story is played in spite of this, and the HAL may stop the robot."
                    if is_last
                    else f"All processes are started again at {rates.hal / 2:g} Hz."
                )
                console.print(f"[yellow]This machine does not keep {rates.hal:g} Hz: {reason} {consequence}[/]")
            if not reason or is_last:
                try:
                    yield Cast(load_robot(file), client, actor, remote, screen)
                except ServiceUnavailable:
                    supervisor.check()  # the last words of a process that ended say more
                    raise
                return
            supervisor.stop_all()


def too_slow(client: Client, actor: Actor, is_last: bool) -> str:
    """Return a sentence on why this machine does not keep the rate while the robot is engaged; empty if it does.

    Raises:
        NotFollowing: The robot does not follow at the last rate.
    """
    try:
        actor.engage()
    except NotFollowing as error:
        if is_last:
            raise
        return str(error)
    counts = pace.count_cycles(client, actor.wait)
    return "" if counts.is_kept else f"{counts}."


def control_of(robot: RobotConfig) -> ControlConfig:
    """Return the settings of control for the story.

    Raises:
        ConfigError: The robot file has no control, or no story fits the robot.
    """
    control = model_config(robot).control
    if control is None:
        raise ConfigError(
            f"The robot file of '{robot.robot}' has no model.control section, so there is nothing to play. Name the "
            f"signal that is moved to targets: `model: {{control: {{target: {robot.command.signal}}}}}`."
        )
    story_of(robot)
    return control


def perform(cast: Cast, seed: int, picture: Path, services: Collection[str], link: str) -> None:
    """Play and draw the story that fits the robot; `link` is that of the page."""
    robot, control = cast.robot, control_of(cast.robot)
    remote = cast.remote

    def footer() -> list[str]:
        counts = f"{CLIENT}: {remote.lines} estimates, {remote.estimated} of them not measured"
        return [counts, f"page: {link}"] if link else [counts]

    story = story_of(robot)
    play = Play(story.names, cast.actor.played, (control.target, *robot.seen), footer)
    scene = Scene(robot, control, cast.client, cast.actor, cast.screen.report, seed, picture)
    with cast.screen.live(robot, cast.client, play, services):
        draw = story.play(scene)
    draw()


def check_start(robot: RobotConfig, with_page: bool = False) -> None:
    """Check, before work that takes minutes, that nothing is missing and no service of this robot runs here.

    Raises:
        ConfigError: The devices of the robot file cannot be built, for example without their data sheets.
        MissingExtra: A package for simulation, training or the page is not installed.
        AlreadyRunning: A service of a robot with this name runs on this machine.
    """
    require("matplotlib", engine_of(robot.physics), *(("viser", "yourdfpy") if with_page else ()))
    open_robot(robot)  # builds the devices, and opens nothing
    running = [service for name, service in services_here() if name == robot.robot]
    if running:
        raise AlreadyRunning(
            f"Services of a robot '{robot.robot}' run on this machine: {', '.join(running)}. The demo starts its own; "
            "stop them first, or give the robot in the file another name."
        )


def make_model(robot: RobotConfig, console: Console) -> None:
    """Collect data and train a model if there is none that fits the robot file."""
    folder = artifacts.model_folder(robot.robot)
    if trainer.fits(robot, folder):
        console.print(f"Using the model in {folder}.")
        return
    console.print("No model yet: the body schema is learned from random motion of the designer's model.")
    with compiling(trainer.has_p(robot)) as compiler:
        with show.progress("collecting") as advance:
            collection = collector.collect_direct(robot, None, 0, progress=advance)
        console.print(f"{len(collection.dataset)} samples, {collection.speed:.0f} times faster than real time.")
        with waiting(console, "compiling"):
            compiler.wait()
    with show.progress("training") as advance:
        result = trainer.train(robot, collection.dataset, 0, advance)
    trainer.show(result, console)
    trainer.save(result, folder)


@contextmanager
def compiling(has_p: bool) -> Iterator[subprocess.Popen[bytes]]:
    """Compile, on a new machine for up to a minute, in a process beside the block; it ends with the block.

    What it cannot compile is compiled later, so its output is not shown, nor how it ends after Ctrl-C.
    """
    process = subprocess.Popen(
        [sys.executable, "-m", "gemuco.warm", *([] if has_p else ["--without-p"])],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        yield process
    finally:
        process.terminate()
        process.wait()


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
    """Start the processes at once, but those that need its buses after the simulator; then a client.

    The client prints estimates of `target`.

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
    for name in commands:
        if name not in AFTER_SIMULATOR:
            supervisor.start(name, gemuco_command(*commands[name]))
    import_module("services.learning.plots")  # matplotlib takes two seconds, in which the processes start
    await_ready("simulator", supervisor, client, console)
    for name in AFTER_SIMULATOR & commands.keys():
        supervisor.start(name, gemuco_command(*commands[name]))
    for name in commands:
        await_ready(name, supervisor, client, console)
    supervisor.start("client", gemuco_command("query", robot.robot, "estimate", target, "--watch"))
    names = ", ".join(f"{child.name} {child.process.pid}" for child in supervisor.children.values())
    console.print(f"[bold]Processes:[/] {names}")


def await_ready(name: str, supervisor: Supervisor, client: Client, console: Console) -> None:
    """Wait until a process publishes that it runs.

    Raises:
        ChildDied: It ended.
        NotReady: It was not ready in time; the message says what arrived of it.
    """
    with waiting(console, f"starting {name}"):
        try:
            supervisor.wait_ready(name, lambda: _is_running(client, name), READY_WITHIN)
        except NotReady as error:
            raise NotReady(f"{error} {_seen_of(client, name)}") from None


def _seen_of(client: Client, name: str) -> str:
    """Return what arrives of a process, in a sentence."""
    status, connected = client.status(name), "connected" if name in client.alive() else "not connected"
    if status is None:
        return f"It is {connected}, and no status arrives."
    estimate = ", and no estimate arrives" if name == "model" and client.estimate() is None else ""
    return f"It is {connected}{estimate}; its status is {status.state}. {status.text}".rstrip()


def _is_running(client: Client, name: str) -> bool:
    """Whether a process runs; a model that estimates does, even if it suspects a sensor.

    Before it has learned what is normal on this body it may suspect one for as long as the arm rests.
    """
    if name == "hal":
        return hal_works(client)
    status = client.status(name)
    if status is None:
        return False
    return status.state == "running" or (name == "model" and client.estimate() is not None)


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
        """Count the new complete lines, and print them unless the output is a terminal."""
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
            if self._console.is_terminal:  # the live view counts them
                continue
            self._console.print(f"    {CLIENT}: {line}", style="dim", highlight=False, markup=False)
