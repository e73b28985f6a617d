"""What a person who looks for what is wrong wants to know of a drive, beside what every CANopen node tells."""

from collections.abc import Iterator

from hal.commissioning.sdo_client import SdoClient
from hal.device import Check
from hal.protocols import cia402
from hal.protocols.cia402 import Mode

UNWATCHED = "{} does not notice when the HAL is gone (no 1016h)."


def drive_checks(sdo: SdoClient, mode: Mode, is_watched: bool, label: str) -> Iterator[Check]:
    """Ask the drive for its mode; what its data sheet lacks is told as well.

    Args:
        sdo: Asks the drive.
        mode: The mode that it should be in.
        is_watched: Whether it notices when the HAL is gone.
        label: The drive, in words.

    Raises:
        DeviceSilent: It does not answer.
    """
    if not is_watched:
        yield Check("watchdog", False, f"{UNWATCHED.format(label)} Let something else cut its power.")
    if not sdo.has(cia402.ABORT_CONNECTION.index):
        text = "There is no object 6007h. Look up in its manual what the drive does when the heartbeat fails."
        yield Check("abort option", False, text)
    if sdo.has(cia402.MODE_DISPLAY.index):
        shown = sdo.read_signed(cia402.MODE_DISPLAY.index, 0, cia402.MODE_DISPLAY.bits)
        text = f"The drive is in mode {cia402.describe_mode(shown)}."
        is_good = shown == mode
        yield Check("mode", is_good, text if is_good else f"{text} Open it again, or look at its display.")
