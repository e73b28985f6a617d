import pytest
from muscle_arm import MuscleArm

from gemuco.dataset import Dataset
from gemuco.learning.train import TrainConfig, fit
from gemuco.schema import BodySchema
from gemuco.structure.determination import Structure, Thresholds, determine

SMALL = TrainConfig(hidden=(60, 20), latent=7, epochs=60, batch=100)


@pytest.fixture(scope="session")
def arm() -> MuscleArm:
    return MuscleArm()


@pytest.fixture(scope="session")
def data(arm: MuscleArm) -> Dataset:
    return arm.episodes(12, 200)


@pytest.fixture(scope="session")
def structure(data: Dataset) -> Structure:
    return determine(data, TrainConfig(hidden=(60, 20), latent=7, epochs=30, batch=100), Thresholds(out=0.3))


@pytest.fixture(scope="session")
def schema(data: Dataset) -> BodySchema:
    masks = [{"joint_position", "muscle_tension"}, {"muscle_tension", "muscle_length"}]
    return fit(data, SMALL, masks)[0]
