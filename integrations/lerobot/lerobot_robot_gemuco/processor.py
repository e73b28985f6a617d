"""A step of LeRobot's processors that says whether an observation is outside of what was learned."""

from dataclasses import dataclass

from lerobot.processor import ObservationProcessorStep, ProcessorStepRegistry

UNKNOWN = "observation.unknown"


@ProcessorStepRegistry.register("gemuco_unknown")
@dataclass
class UnknownProcessorStep(ObservationProcessorStep):
    """Add `observation.unknown`: 1 if the estimate of any signal is outside of what was learned, else 0.

    Attributes:
        refuse: Raise an error instead, so that a policy never acts on such an observation.
    """

    refuse: bool = False

    def observation(self, observation: dict) -> dict:
        """Return the observation with the mark.

        Raises:
            ValueError: `refuse` is set, and a signal is unknown; or the observation has no marks.
        """
        marks = {name: float(value) for name, value in observation.items() if name.endswith(".unknown")}
        if not marks:
            raise ValueError("This observation has no `SIGNAL.unknown`. Is it one of a robot of gemuco?")
        unknown = [name.removesuffix(".unknown") for name, value in marks.items() if value > 0.5]
        if unknown and self.refuse:
            raise ValueError(f"The estimate of {', '.join(unknown)} is outside of what was learned.")
        return {**observation, UNKNOWN: float(bool(unknown))}

    def get_config(self) -> dict:
        """Return the settings for a saved pipeline."""
        return {"refuse": self.refuse}

    def transform_features(self, features: dict) -> dict:
        """Return the features; the mark is a number beside them."""
        return features
