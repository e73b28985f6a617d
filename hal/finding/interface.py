"""Whether the interfaces of a robot's buses are there, up, and set as its file says."""

from collections.abc import Iterator

from hal import registry
from hal.config import BusConfig, RobotConfig
from hal.finding import link
from hal.finding.findings import Finding, bad, ok, warning


def interfaces(config: RobotConfig) -> Iterator[Finding]:
    """Whether the interfaces are there, up, and set as the robot file says."""
    for name, bus in config.buses.items():
        what = f"interface {name}"
        if bus.interface == "socketcan":
            commands = sum(bool(_commanded(config, device)) for device, at in config.devices.items() if at.bus == name)
            yield from socketcan(what, bus, link.look_up(bus.channel), commands)
        elif bus.interface == "virtual":
            yield warning(
                what, "'virtual' lives inside one process, for tests. For two processes use `interface: hub`."
            )
        elif bus.interface == "hub":
            yield ok(what, f"hub '{bus.channel}', for simulated nodes: it has no bit rate and no errors of its own.")
        else:
            yield warning(what, f"{bus.interface} {bus.channel}: what its adapter is set to cannot be looked up here.")


def socketcan(what: str, bus: BusConfig, found: link.Link | None, commands: int) -> Iterator[Finding]:
    """The state of a Linux CAN interface; `commands` frames are sent at once beside the SYNC."""
    up = f"sudo ip link set {bus.channel} up type can bitrate {bus.bitrate} restart-ms 100"
    if found is None:
        known = ", ".join(link.known_links()) or "none"
        yield bad(
            what, f"There is no interface '{bus.channel}'. CAN interfaces here: {known}. Is the adapter plugged in?"
        )
        return
    if not found.is_can:
        yield bad(what, f"'{bus.channel}' is no CAN interface. Those here: {', '.join(link.known_links()) or 'none'}.")
        return
    if not found.is_up:
        command = up if found.kind in ("can", "") else f"sudo ip link set {bus.channel} up"
        yield bad(what, f"'{bus.channel}' is down. Set it up with `{command}`.")
        return
    yield ok(what, f"'{bus.channel}' ({found.kind or 'CAN'}) is up.")
    if found.kind == "can":
        if found.bitrate != bus.bitrate:
            yield bad(
                f"bit rate {what.split()[-1]}",
                f"{found.bitrate} bit/s, and the robot file says {bus.bitrate}. "
                f"`sudo ip link set {bus.channel} down; {up}`",
            )
        else:
            yield ok(f"bit rate {what.split()[-1]}", f"{bus.bitrate / 1e3:g} kbit/s.")
        yield from _controller(what.split()[-1], bus, found)
    if found.queue is not None and found.queue < commands + 2:
        more = f"sudo ip link set {bus.channel} txqueuelen {4 * (commands + 2)}"
        yield warning(
            f"queue {what.split()[-1]}", f"{found.queue} frames, and {commands + 2} are sent at once. `{more}`"
        )


def _controller(name: str, bus: BusConfig, found: link.Link) -> Iterator[Finding]:
    if not found.restart:
        yield warning(
            f"restart {name}",
            "The controller stays off after bus-off. "
            f"`sudo ip link set {bus.channel} down; sudo ip link set {bus.channel} type can restart-ms 100`",
        )
    else:
        yield ok(f"restart {name}", f"{found.restart * 1e3:g} ms after bus-off.")
    if found.state not in ("ERROR-ACTIVE", ""):
        is_lost = found.state in ("BUS-OFF", "STOPPED")
        text = f"The controller is {found.state}. Check wiring, both 120 ohm terminations, and every node's bit rate."
        yield bad(f"controller {name}", text) if is_lost else warning(f"controller {name}", text)


def _commanded(config: RobotConfig, device: str) -> str | None:
    driver, settings = registry.equipment(config, device)
    quantity: str | None = driver.commanded(settings)
    return quantity
