"""Optional packages: the extra that brings a package, and the sentence that names it."""

import importlib.util

from services.errors import ServiceError

EXTRAS = {
    "matplotlib": "train",
    "pybullet": "sim",
    "mujoco": "sim",
    "viser": "view",
    "yourdfpy": "view",
    "pyarrow": "parquet",
    "prometheus_client": "metrics",
    "foxglove": "foxglove",
    "serial": "serial",
    "rerun": "rerun",
    "joblib": "studies",
}
"""Each of these packages is brought by this extra of pyproject.toml."""


class MissingExtra(ServiceError):
    """A package that this installation lacks; the text names the extra that brings it."""


def require(*packages: str) -> None:
    """Check that packages are installed, before work that would be lost without them.

    Raises:
        MissingExtra: One is not installed.
    """
    missing = [name for name in packages if is_missing(name)]
    if missing:
        raise MissingExtra(sentence(*missing))


def engine_of(physics: str | None) -> str:
    """Return the package of rigid bodies that a robot file names; else MuJoCo if only this one is installed."""
    if physics is None:
        has_only_mujoco = is_missing("pybullet") and not is_missing("mujoco")
        return "mujoco" if has_only_mujoco else "pybullet"
    return {"bullet": "pybullet"}.get(physics, physics)


def is_missing(package: str) -> bool:
    """Whether a package is not installed."""
    return importlib.util.find_spec(package) is None


def sentence(*missing: str) -> str:
    """Return a sentence on packages that are not installed, with the command that installs them."""
    extras = ",".join(dict.fromkeys(EXTRAS[name] for name in missing if name in EXTRAS))
    names = ", ".join(f"'{name}'" for name in missing)
    command = f": pip install 'gemuco[{extras}]'." if extras else "."
    return f"This needs the {'package' if len(missing) == 1 else 'packages'} {names}, not installed here{command}"
