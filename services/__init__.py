"""The processes: hardware service, body schema service, recorder, clients and the command line.

`from services import Client` is the front door. A name is imported when it is first used, so that `import services`
loads nothing else.
"""

from importlib import import_module

TYPE_CHECKING = False

_ROOMS = {
    "services.client.client": ("Client",),
    "services.measured.description": ("load_measured",),
    "services.measured.reading": ("read_measured",),
    "services.process.service": ("Service",),
    "services.wire.records": ("Sample",),
    "services.errors": (
        "CommandHeld",
        "LeaseLost",
        "NotAllowed",
        "ServiceError",
        "ServiceUnavailable",
        "TooSlow",
        "WrongVersion",
    ),
}
_ROOM_OF = {name: room for room, names in _ROOMS.items() for name in names}
__all__ = sorted(_ROOM_OF)

if TYPE_CHECKING:
    from services.client.client import Client as Client
    from services.errors import CommandHeld as CommandHeld
    from services.errors import LeaseLost as LeaseLost
    from services.errors import NotAllowed as NotAllowed
    from services.errors import ServiceError as ServiceError
    from services.errors import ServiceUnavailable as ServiceUnavailable
    from services.errors import TooSlow as TooSlow
    from services.errors import WrongVersion as WrongVersion
    from services.measured.description import load_measured as load_measured
    from services.measured.reading import read_measured as read_measured
    from services.process.service import Service as Service
    from services.wire.records import Sample as Sample
else:

    def __getattr__(name: str) -> object:
        """Import an exported name from its room."""
        if name not in _ROOM_OF:
            raise AttributeError(f"module 'services' has no attribute '{name}'")
        globals()[name] = value = getattr(import_module(_ROOM_OF[name]), name)
        return value


def __dir__() -> list[str]:
    """Return the exported names."""
    return __all__
