"""Models of the Dynamixel X series: number, unit of the current, and bus watchdog.

Source: the control table of each model at emanual.robotis.com/docs/en/dxl/x. That the bus watchdog of the 330 models
reports to have stopped a motor which it did not stop: forum.robotis.com/t/4814, confirmed there by the maker.
"""

from dataclasses import dataclass

from hal.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Model:
    """Properties of one model.

    Attributes:
        number: Number in its register 0.
        current_unit: Unit of its current [A]; None for a model that has a load in place of it.
        stops_alone: Whether its bus watchdog stops the motor.
    """

    number: int
    current_unit: float | None
    stops_alone: bool = True


_M, _SMALL = 2.69e-3, 1e-3

MODELS = {
    "XL430-W250": Model(1060, None),
    "2XL430-W250": Model(1090, None),
    "XC430-W150": Model(1070, None),
    "XC430-W240": Model(1080, None),
    "2XC430-W250": Model(1160, None),
    "XM430-W210": Model(1030, _M),
    "XM430-W350": Model(1020, _M),
    "XM540-W150": Model(1130, _M),
    "XM540-W270": Model(1120, _M),
    "XH430-W210": Model(1010, _M),
    "XH430-W350": Model(1000, _M),
    "XH540-W150": Model(1110, _M),
    "XH540-W270": Model(1100, _M),
    "XL330-M077": Model(1190, _SMALL, False),
    "XL330-M288": Model(1200, _SMALL, False),
    "XC330-M181": Model(1230, _SMALL, False),
    "XC330-M288": Model(1240, _SMALL, False),
    "XC330-T181": Model(1210, _SMALL, False),
    "XC330-T288": Model(1220, _SMALL, False),
}
"""Name -> properties."""

NAMES = {model.number: name for name, model in MODELS.items()}
"""Number -> name."""


def model(name: str) -> Model:
    """Return the properties of a model.

    Raises:
        ConfigError: The model is unknown.
    """
    if name not in MODELS:
        raise ConfigError(f"There is no model '{name}' in the table. Known: {', '.join(MODELS)}.")
    return MODELS[name]
