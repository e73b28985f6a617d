"""Report of a story: a table in the terminal, and one HTML file without links to other files, which can be sent."""

import base64
import os
import platform
import shlex
import time
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib import metadata
from pathlib import Path

from rich.console import Console
from rich.table import Table

from gemuco.writing import replace, writing
from hal.errors import ConfigError
from services.demo.actor import Stage
from services.model.artifacts import robot_file

CLIENT = "remote client"
LEAST_LINES = 20
"""The remote client must have printed this many estimates to count as observed."""
STYLE = """
:root{color-scheme:light dark;--line:#d5dae1;--dim:#626b78;--good:#137a3f;--bad:#b3261e;--card:#f6f8fa}
@media(prefers-color-scheme:dark){:root{--line:#39404c;--dim:#9aa5b5;--good:#63d297;--bad:#ff8f8f;--card:#1b1f26}}
body{font:16px/1.5 system-ui,'Segoe UI',sans-serif;max-width:60rem;margin:0 auto;padding:1.2rem}
h1{font-size:1.5rem;margin:.2rem 0}h2{font-size:1.1rem;margin:1.8rem 0 .5rem}.dim{color:var(--dim)}
section{border:1px solid var(--line);border-radius:8px;background:var(--card);padding:.6rem 1rem;margin:.6rem 0}
section h3{font-size:1rem;margin:.1rem 0 .3rem;display:flex;gap:.6rem;flex-wrap:wrap}
section h3 .dim{margin-left:auto;font-weight:400}ul{margin:.2rem 0;padding-left:1.2rem}
.yes{color:var(--good)}.no{color:var(--bad)}img{width:100%;height:auto;background:#fff;border-radius:8px}
table{border-collapse:collapse}td{padding:.15rem 1.2rem .15rem 0;vertical-align:top}code,pre{font-size:.85rem}
pre{white-space:pre-wrap;border:1px solid var(--line);border-radius:8px;padding:.6rem 1rem;background:var(--card)}
"""


@dataclass(frozen=True, slots=True)
class Ending:
    """Results of a story.

    Attributes:
        robot: Name of the robot.
        stages: Played stages.
        stops: Number of times that the HAL stopped the robot by itself.
        lines: Estimates printed by the remote client.
        estimated: Estimates among them that were not measured.
        rate: Rate at which the HAL ran [Hz].
        wanted: Rate of the robot file [Hz].
    """

    robot: str
    stages: Sequence[Stage]
    stops: int
    lines: int
    estimated: int
    rate: float
    wanted: float

    @property
    def is_client_observed(self) -> bool:
        """Whether the remote client printed enough estimates, of which some were not measured."""
        return self.lines >= LEAST_LINES and self.estimated > 0

    @property
    def is_observed(self) -> bool:
        """Whether all expected events were observed."""
        return self.is_client_observed and all(stage.observed for stage in self.stages)

    @property
    def client(self) -> str:
        """Sentence on the remote client."""
        return f"{self.lines} estimates printed by a separate process, {self.estimated} of them not measured"


def show(ending: Ending, console: Console) -> None:
    """Print a table of the stages."""
    table = Table(title="What happened", title_justify="left", show_lines=True)
    table.add_column("stage")
    table.add_column("measured")
    table.add_column("observed", justify="center")
    for stage in ending.stages:
        table.add_row(stage.name, "\n".join(stage.figures), _yes(stage.observed))
    table.add_row(CLIENT, ending.client, _yes(ending.is_client_observed))
    console.print(table)
    if ending.stops:
        console.print(f"The HAL stopped the arm {ending.stops} times by itself, see above.")


def show_files(out: Path, console: Console) -> None:
    """Print which files a play has made."""
    console.print(f"Plot: {out / 'story.png'}   recording: {out / 'story.mcap'}   logs: {out}/*.log")
    console.print(f"Report, one file to send: {out / 'report.html'}")


def _yes(observed: bool) -> str:
    return "[green]yes[/]" if observed else "[red]no[/]"


def write(ending: Ending, path: Path, seed: int, picture: Path) -> None:
    """Write the HTML file with the picture in it.

    Args:
        ending: Results of the story.
        path: The robot file.
        seed: Seed of the simulated actual robot.
        picture: Plot of the story (PNG); the report lies beside it.
    """
    file = picture.with_name("report.html")
    with writing("The report", file):
        replace(file, html(ending, path, seed, picture).encode())


def html(ending: Ending, path: Path, seed: int, picture: Path) -> str:
    """Return the report; arguments as those of `write`."""
    observed = sum(stage.observed for stage in ending.stages)
    verdict = "All expected events were observed." if ending.is_observed else "Not every expected event was observed."
    parts = [
        f"<h1>{escape(ending.robot)}: demo of gemuco</h1>",
        f'<p class="dim">{time.strftime("%d %B %Y, %H:%M")} · simulated robot, seed {seed}</p>',
        f'<p class="{_word(ending.is_observed)}"><b>{verdict}</b> {observed} of {len(ending.stages)} stages.</p>',
        "<p>A service with a learned body schema ran beside a simulated robot, whose sensors and parts were broken on "
        "purpose. The service was expected to notice this and to go on. Every figure was measured in this run.</p>",
        "<h2>Stages</h2>",
        *(_stage(stage) for stage in ending.stages),
        f'<section><h3><span class="{_word(ending.is_client_observed)}">{_mark(ending.is_client_observed)}</span>'
        f"<span>{CLIENT}</span></h3>{escape(ending.client)}</section>",
        "<h2>The run</h2>",
        _image(picture, ending),
        "<h2>Where it ran</h2>",
        _facts(ending, path),
        "<h2>See it again</h2>",
        f"<pre>{escape(_commands(ending, path, seed, picture))}</pre>",
    ]
    head = (
        '<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" '
        f'content="width=device-width,initial-scale=1"><title>{escape(ending.robot)}: demo of gemuco</title>'
    )
    return f"{head}<style>{STYLE}</style><body>{''.join(parts)}</body></html>\n"


def _stage(stage: Stage) -> str:
    figures = "".join(f"<li>{escape(figure)}</li>" for figure in stage.figures)
    return (
        f'<section><h3><span class="{_word(stage.observed)}">{_mark(stage.observed)}</span><span>{escape(stage.name)}'
        f'</span><span class="dim">{stage.start:.0f} s to {stage.end:.0f} s</span></h3><ul>{figures}</ul></section>'
    )


def _image(picture: Path, ending: Ending) -> str:
    data = base64.b64encode(picture.read_bytes()).decode()
    stages = ", ".join(stage.name for stage in ending.stages)
    return f'<img alt="Curves of the run: {escape(stages)}" src="data:image/png;base64,{data}">'


def _facts(ending: Ending, path: Path) -> str:
    kept = "" if ending.rate == ending.wanted else f", because {ending.wanted:g} Hz are too much for this machine"
    rows = {
        "robot file": path.name,
        "rate": f"{ending.rate:g} Hz{kept}",
        "stopped by the HAL": f"{ending.stops} times by itself",
        "gemuco": metadata.version("gemuco"),
        "machine": f"{platform.system()}, {platform.machine()}, {os.cpu_count()} cores, Python "
        f"{platform.python_version()}",
    }
    cells = "".join(f'<tr><td class="dim">{name}</td><td>{escape(text)}</td></tr>' for name, text in rows.items())
    return f"<table>{cells}</table>"


def _commands(ending: Ending, path: Path, seed: int, picture: Path) -> str:
    recording = shlex.quote(str(picture.with_name("story.mcap")))
    return (
        f"gemuco demo {shlex.quote(_robot(path))} --seed {seed} --view   # again, with the page in the browser\n"
        f"gemuco replay {recording} --model   # the recording of this run, in place of the robot\n"
        f"gemuco view {shlex.quote(ending.robot)}   # meanwhile, in a second terminal\n"
    )


def _robot(path: Path) -> str:
    """Return the name of a robot that is a part of gemuco, else the name of its file."""
    try:
        return path.stem if robot_file(path.stem).resolve() == path.resolve() else path.name
    except ConfigError:
        return path.name


def _word(observed: bool) -> str:
    return "yes" if observed else "no"


def _mark(observed: bool) -> str:
    return "✓" if observed else "✗"
