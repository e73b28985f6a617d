"""The Axes that a picture is drawn into."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BLUE, RED, GREY = "tab:blue", "tab:red", "0.45"


def axes_of(axes: "Axes | None", width: float, height: float) -> "Axes":
    """Return the given Axes, or those of a new figure of this size [inches].

    Raises:
        ModuleNotFoundError: matplotlib is not installed; the text names the extra that brings it.
    """
    if axes is not None:
        return axes
    try:
        import matplotlib.pyplot as plt
    except ModuleNotFoundError as error:
        if error.name != "matplotlib":
            raise
        text = "gemuco.plot needs the package 'matplotlib', not installed here: pip install 'gemuco[train]'."
        raise ModuleNotFoundError(text, name="matplotlib") from None
    _, own = plt.subplots(figsize=(width, height), layout="constrained")
    return own
