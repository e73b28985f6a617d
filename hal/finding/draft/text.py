"""The text of a drafted robot file."""

from collections.abc import Mapping, Sequence
from typing import Any

import yaml

from hal.config import BusConfig
from hal.finding.draft.parts import Part

HEAD = """\
# `gemuco init` drafted this from {source}; docs/robots.md explains every section, docs/devices.md every device.
# Complete the lines with "set", and compare the others with the manuals: no file knows a gear, a zero or a limit.
{notes}robot: {robot}

signals:
{signals}
command: {{signal: {command}, time_to_live: 0.1, hold: 1.0}}

limits:  # set: the range, and the rate, in which nothing can break
  {command}: {{low: -0.5, high: 0.5, rate: 0.5, acceleration: 2.0}}

stop: {{behaviour: hold}}

rates: {{hal: 100, estimation: 100, control: 25, anomaly: 25, update: 5}}

# From the bench to real hardware: {real}
buses:
{buses}
kinds:
{kinds}
devices:
{devices}
simulator: simulators.robots.bench:body  # every device answers; made-up functions let the sensors follow the drives

collect: {{samples: 2000, rate: 10}}  # random postures within the limits

model:
  # 0.5 is 70 % of a standard deviation: every signal is an output, and its expected error says how good it is.
  structure: {{threshold_out: 0.5, threshold_in: 0.5}}
  control: {{target: {command}, speed: 0.4}}  # below the rate above
"""


def robot_text(
    robot: str,
    source: str,
    bus: str,
    real: str,
    rates: BusConfig,
    parts: Sequence[Part],
    notes: Sequence[str],
) -> str:
    """Return the robot file of some devices, of which at least one is a drive.

    Args:
        robot: Name of the robot.
        source: What it was drafted from, in words.
        bus: Name of its bus; a number at its end is counted up for further ones.
        real: Interface and channel of the real bus, as YAML.
        rates: A bus with the bit rates of each; one without devices of CAN FD has none for its data.
        parts: The devices.
        notes: Sentences on what was left out or guessed.
    """
    simulated = "pty" if real.startswith(("interface: serial", "interface: pty")) else "hub"
    stem = bus.rstrip("0123456789")
    first = int(bus[len(stem) :] or 0)
    names = [bus, *(f"{stem}{first + more}" for more in range(1, 1 + max(part.bus for part in parts)))]
    return HEAD.format(
        source=source,
        notes="".join(f"# {note}\n" for note in notes),
        robot=robot,
        signals="".join(_signals(parts)),
        command=next(part.measures[0].signal for part in parts if part.is_drive),
        real=real,
        buses="".join(
            f"  {name}: {{interface: {simulated}, channel: {robot}_{name}, {_bit_rates(rates, number, parts)}}}\n"
            for number, name in enumerate(names)
        ),
        kinds="".join(_kind(part) for part in parts),
        devices="".join(_device(part, names[part.bus]) for part in parts),
    )


def _bit_rates(rates: BusConfig, number: int, parts: Sequence[Part]) -> str:
    is_fd = any(part.is_fd for part in parts if part.bus == number)
    return f"bitrate: {rates.bitrate}" + (f", data_bitrate: {rates.data_bitrate}" if is_fd else "")


def _signals(parts: Sequence[Part]) -> list[str]:
    measures = [measure for part in parts for measure in part.measures]
    lines = []
    for signal in dict.fromkeys(measure.signal for measure in measures):
        own = [measure for measure in measures if measure.signal == signal]
        elements = ", ".join(measure.element for measure in own)
        stale = max(measure.stale_after for measure in own)
        lines.append(f"  {signal}: {{unit: {_flow(own[0].unit)}, elements: [{elements}], stale_after: {stale:g}}}\n")
    return lines


def _kind(part: Part) -> str:
    remark = f"  # set: {part.to_set}" if part.to_set else ""
    head = f"  {part.name}:  # {part.origin}\n    driver: {part.driver}\n"
    if len(str(part.settings)) < 90:
        return f"{head}    settings: {_flow(part.settings)}{remark}\n"
    lines = [f"    settings:{remark}\n"]
    for key, value in part.settings.items():
        if isinstance(value, Mapping) and len(str(value)) >= 90:
            lines.append(f"      {key}:\n")
            lines += [f"        {name}: {_flow(entry)}\n" for name, entry in value.items()]
        else:
            lines.append(f"      {key}: {_flow(value)}\n")
    return head + "".join(lines)


def _device(part: Part, bus: str) -> str:
    served = {measure.quantity: f"{measure.signal}.{measure.element}" for measure in part.measures}
    if len(served) == 1:
        place = f"kind: {part.name}, bus: {bus}, node: {part.node}"
        return f"  {part.name}: {{{place}, element: {next(iter(served.values()))}}}\n"
    lines = "".join(f"      {quantity}: {element}\n" for quantity, element in served.items())
    return f"  {part.name}:\n    kind: {part.name}\n    bus: {bus}\n    node: {part.node}\n    elements:\n{lines}"


def _flow(value: Any) -> str:
    """Return a value as YAML in one line."""
    text = yaml.safe_dump(value, default_flow_style=True, width=10_000, sort_keys=False, allow_unicode=True)
    return text.removesuffix("\n").removesuffix("\n...")
