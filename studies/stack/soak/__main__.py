"""Endurance of a whole simulated robot while something breaks every minute.

    python -m studies.stack.soak --minutes 60

Router, simulator, HAL, model with online update, and recorder of a light robot (six CANopen nodes on a hub bus) run as
processes; this process is the operator's client, through the router, beside ten others. The robot is engaged and moves
to a random target every two seconds. Ten seconds after the start of each minute something breaks, and thirty seconds
later it is mended: a sensor lies, falls silent or reboots, all messages are played again, a client floods, the disk
is full, or (in the first third of the run) a process is killed. Five seconds before the end of the minute the operator
trusts again what is still distrusted.

A referee compares all that is called measured with the truth of the simulator. Once a minute the study reads memory,
threads, open files and processor time of every process, and ticks, skips and lateness of every loop. Bare timer loops
with the same rates and priorities measure the skips that the machine causes. The study ends with verdicts and a JSON
file. The full disk needs root; it is a disk in memory.
"""

import argparse
from pathlib import Path

from rich.console import Console

from studies.stack.soak.campaign import run
from studies.stack.soak.verdicts import judge

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=int, default=60)
    parser.add_argument("--out", type=Path, default=Path("runs/soak.json"))
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="FAULT", help="these faults in turn, such as 'kill hal'"
    )
    options = parser.parse_args()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    terminal = Console(width=140)
    verdict = "ALL GOOD" if judge(run(options.minutes, options.out, options.only), terminal) else "NOT ALL GOOD"
    terminal.print(verdict, f"over {options.minutes} minutes; {options.out}")
