"""Share of cut muscles and shifted encoders that are identified correctly, from one sample and from a window.

    python -m studies.accuracy.blame [--arms 3]

On each of several actual arms the model first learns four simulated minutes of motion, then its normal errors. Then
every muscle is cut in turn, and every encoder reads 0.3 rad too much. The first twenty samples above the threshold are
judged one by one (`gemuco.anomaly.score`) and together (`gemuco.anomaly.blame`). Faults with less than three such
samples are left out.
"""

import argparse
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from gemuco.adaption.config import UpdateConfig
from gemuco.adaption.update import Updater
from gemuco.anomaly.blame import suspects
from gemuco.anomaly.healthy import learn_normal
from gemuco.anomaly.window import scores
from gemuco.schema import BodySchema
from hal.config import RobotConfig, load_robot
from services.model.model_config import model_config
from studies.bodies.actual_arms import model, record

JOINTS, TENSIONS = "joint_position", "muscle_tension"
OFF = 0.3
"""A shifted encoder reads this angle too much [rad]."""
WINDOW = 20


def learn(robot: RobotConfig, schema: BodySchema, arm: int) -> BodySchema:
    """Return the model of one actual arm, with its normal errors."""
    config = model_config(robot).update
    lived, fresh = record(robot, arm, 100 + arm, 10.0, 240.0), record(robot, arm, 500 + arm, 20.0, 60.0)
    updater = Updater(schema, UpdateConfig(**config.model_dump(exclude={"interval"})))
    for index in range(len(lived[JOINTS])):
        updater.add({name: values[index] for name, values in lived.items()})
        updater.step()
    schema = updater.schema
    return schema.with_normal(learn_normal(schema, schema.layout.join(fresh)))


def judge(schema: BodySchema, rows: dict[str, np.ndarray], right: str) -> tuple[float, float] | None:
    """Return the share of single samples that blame the correct name, and 1.0 if the window blames it, else 0.0.

    Return None with fewer than three samples above the threshold.
    """
    x = schema.normalise(rows)
    assert schema.normal is not None
    odd = x[scores(schema, x) > schema.normal.threshold][:WINDOW]
    if len(odd) < 3:
        return None
    single = [suspects(schema, row[None])[0].name.endswith(f".{right}") for row in odd]
    return float(np.mean(single)), float(suspects(schema, odd)[0].name.endswith(f".{right}"))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", type=int, default=3)
    options = parser.parse_args()
    console = Console(width=140)
    robot = load_robot(Path("robots/musashi_arm.yaml"))
    trained = model(robot, console)
    table = Table("arm", "fault", "cases", "single sample right", "window right")
    for arm in range(options.arms):
        schema = learn(robot, trained, arm)
        cut = {m: record(robot, arm, 900 + arm, 20.0, 8.0, f"muscle_cut:{m}") for m in robot.signals[TENSIONS].elements}
        healthy = record(robot, arm, 700 + arm, 5.0, 20.0)
        off = {
            joint: healthy | {JOINTS: healthy[JOINTS] + OFF * np.eye(len(robot.signals[JOINTS].elements))[index]}
            for index, joint in enumerate(robot.signals[JOINTS].elements)
        }
        for label, faults in (("muscle cut", cut), ("encoder off", off)):
            verdicts = [verdict for name, rows in faults.items() if (verdict := judge(schema, rows, name)) is not None]
            single, window = np.mean(verdicts, axis=0) if verdicts else (np.nan, np.nan)
            table.add_row(str(arm), label, str(len(verdicts)), f"{single:.2f}", f"{window:.2f}")
    console.print(table)
