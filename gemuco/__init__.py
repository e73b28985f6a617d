"""The model: a body schema on plain arrays, without robot, bus or clock.

Users import from here: `from gemuco import estimate`. A name is imported from its room at its first use, so
`import gemuco` does not load numpy.
"""

from importlib import import_module

TYPE_CHECKING = False

_ROOMS = {
    "gemuco.adaption.adapt": ("adapt",),
    "gemuco.adaption.config": ("UpdateConfig",),
    "gemuco.adaption.update": ("Updater",),
    "gemuco.anomaly.score": ("AnomalyScore", "score"),
    "gemuco.anomaly.verdict": ("Verdict", "judge"),
    "gemuco.checkpoint": ("load", "save"),
    "gemuco.controller": ("Controller", "Solution", "control"),
    "gemuco.dataset": ("Dataset", "Episode", "as_dataset"),
    "gemuco.errors": (
        "CheckpointError",
        "DatasetError",
        "NotEnoughData",
        "NotFinite",
        "NotObservable",
        "NotWritten",
        "SchemaError",
        "UnknownCondition",
        "UnknownSignal",
        "WrongKind",
        "WrongSize",
    ),
    "gemuco.estimation": ("Estimate", "estimate"),
    "gemuco.learning.config": ("TrainConfig",),
    "gemuco.learning.train": ("fit",),
    "gemuco.learning.tune": ("fine_tune",),
    "gemuco.schema": ("BodySchema",),
    "gemuco.search.descent": ("DescentConfig", "NewtonConfig"),
    "gemuco.search.losses": ("Hold", "Match", "StayNear", "StaySmall"),
    "gemuco.search.torque": ("TorqueBalance",),
    "gemuco.signals": ("Layout", "Signal"),
    "gemuco.simulation": ("SimulatedState", "Simulator", "simulate"),
    "gemuco.structure.determination": ("Structure", "determine", "learn"),
    "gemuco.structure.mask_judge": ("Thresholds",),
    "gemuco.trust.config": ("TrustConfig",),
    "gemuco.trust.inspection": ("Inspection", "Inspector", "Lie", "inspect"),
}
_ROOM_OF = {name: room for room, names in _ROOMS.items() for name in names}
__all__ = sorted(_ROOM_OF)

if TYPE_CHECKING:
    from gemuco.adaption.adapt import adapt as adapt
    from gemuco.adaption.config import UpdateConfig as UpdateConfig
    from gemuco.adaption.update import Updater as Updater
    from gemuco.anomaly.score import AnomalyScore as AnomalyScore
    from gemuco.anomaly.score import score as score
    from gemuco.anomaly.verdict import Verdict as Verdict
    from gemuco.anomaly.verdict import judge as judge
    from gemuco.checkpoint import load as load
    from gemuco.checkpoint import save as save
    from gemuco.controller import Controller as Controller
    from gemuco.controller import Solution as Solution
    from gemuco.controller import control as control
    from gemuco.dataset import Dataset as Dataset
    from gemuco.dataset import Episode as Episode
    from gemuco.dataset import as_dataset as as_dataset
    from gemuco.errors import CheckpointError as CheckpointError
    from gemuco.errors import DatasetError as DatasetError
    from gemuco.errors import NotEnoughData as NotEnoughData
    from gemuco.errors import NotFinite as NotFinite
    from gemuco.errors import NotObservable as NotObservable
    from gemuco.errors import NotWritten as NotWritten
    from gemuco.errors import SchemaError as SchemaError
    from gemuco.errors import UnknownCondition as UnknownCondition
    from gemuco.errors import UnknownSignal as UnknownSignal
    from gemuco.errors import WrongKind as WrongKind
    from gemuco.errors import WrongSize as WrongSize
    from gemuco.estimation import Estimate as Estimate
    from gemuco.estimation import estimate as estimate
    from gemuco.learning.config import TrainConfig as TrainConfig
    from gemuco.learning.train import fit as fit
    from gemuco.learning.tune import fine_tune as fine_tune
    from gemuco.schema import BodySchema as BodySchema
    from gemuco.search.descent import DescentConfig as DescentConfig
    from gemuco.search.descent import NewtonConfig as NewtonConfig
    from gemuco.search.losses import Hold as Hold
    from gemuco.search.losses import Match as Match
    from gemuco.search.losses import StayNear as StayNear
    from gemuco.search.losses import StaySmall as StaySmall
    from gemuco.search.torque import TorqueBalance as TorqueBalance
    from gemuco.signals import Layout as Layout
    from gemuco.signals import Signal as Signal
    from gemuco.simulation import SimulatedState as SimulatedState
    from gemuco.simulation import Simulator as Simulator
    from gemuco.simulation import simulate as simulate
    from gemuco.structure.determination import Structure as Structure
    from gemuco.structure.determination import determine as determine
    from gemuco.structure.determination import learn as learn
    from gemuco.structure.mask_judge import Thresholds as Thresholds
    from gemuco.trust.config import TrustConfig as TrustConfig
    from gemuco.trust.inspection import Inspection as Inspection
    from gemuco.trust.inspection import Inspector as Inspector
    from gemuco.trust.inspection import Lie as Lie
    from gemuco.trust.inspection import inspect as inspect
else:

    def __getattr__(name: str) -> object:
        """Import an exported name from its room, or the room `plot`."""
        if name == "plot":
            return import_module("gemuco.plot")
        if name not in _ROOM_OF:
            raise AttributeError(f"module 'gemuco' has no attribute '{name}'")
        globals()[name] = value = getattr(import_module(_ROOM_OF[name]), name)
        return value


def __dir__() -> list[str]:
    """Return the exported names."""
    return __all__
