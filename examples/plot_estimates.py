"""Plot the last seconds of a running robot and the next ones as they come: measured and estimated values.

python examples/plot_estimates.py ROBOT [tcp/ROUTER:7447 or a role file] [--seconds 10] [--live 2] [--out estimates.png]

Needs no robot file and no code of the robot: the robot describes its units and elements.
"""

import argparse
import sys
import time

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from services import Client, ServiceError

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("robot")
parser.add_argument("connect", nargs="*")
parser.add_argument("--seconds", type=float, default=10.0, help="of the past")
parser.add_argument("--live", type=float, default=2.0, help="seconds of new estimates")
parser.add_argument("--out", default="estimates.png")
options = parser.parse_args()

try:
    with Client(options.robot, options.connect) as robot:
        about = robot.describe()
        past = robot.history(options.seconds)
        live, begun = [], time.monotonic()
        for now in robot.estimates():
            live.append(now)
            if time.monotonic() - begun > options.live:
                break
        anomaly = robot.anomaly()
except ServiceError as error:
    sys.exit(str(error))
if not len(past.stamp_ns):
    sys.exit(f"The model service of '{options.robot}' has published no estimate yet.")

zero = past.stamp_ns[-1]
seconds = np.concatenate([past.stamp_ns - zero, [now.stamp_ns - zero for now in live]]) * 1e-9
figure, axes = plt.subplots(len(past.values), sharex=True, figsize=(10, 2.6 * len(past.values)), squeeze=False)
for axis, (signal, before) in zip(axes[:, 0], past.values.items(), strict=True):
    values = np.concatenate([before, [now.values[signal] for now in live]])
    estimated = np.concatenate([past.estimated[signal], [now.estimated[signal] for now in live]])
    for number, element in enumerate(about["signals"][signal]["elements"]):
        color = f"C{number}"
        axis.plot(seconds, np.where(estimated[:, number], np.nan, values[:, number]), color=color, label=element)
        axis.plot(seconds, np.where(estimated[:, number], values[:, number], np.nan), ":", color=color, linewidth=2.5)
    axis.axvline(0.0, color="black", linewidth=0.5)
    axis.set_ylabel(f"{signal} [{about['signals'][signal]['unit']}]", fontsize=8)
    axis.legend(fontsize=6, loc="center left", bbox_to_anchor=(1.0, 0.5))
state = "not judged" if anomaly is None else f"score {anomaly.score:.1f} of {anomaly.threshold:.1f} {anomaly.verdict}"
axes[0, 0].set_title(
    f"{options.robot}: history, and live from 0 s on; dotted is estimated; anomaly {state}", fontsize=9
)
axes[-1, 0].set_xlabel("time [s]")
figure.tight_layout()
figure.savefig(options.out, dpi=100)
print(f"{len(past.stamp_ns)} estimates of the past and {len(live)} live ones are in {options.out}.")
