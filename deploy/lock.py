"""Write requirements.lock: the packages of the images and of `make setup` with versions and the hashes of their files.

`lock.py REPORT` reads the report of `pip install --dry-run --ignore-installed --report` (`make lock`). Packages of
`WITHOUT` have no hash: see docs/design.md.
"""

import json
import re
import sys
from pathlib import Path

from packaging.requirements import Requirement

LOCK = Path(__file__).parents[1] / "requirements.lock"
OWN = "gemuco"
WITHOUT = ("torch",)
HEAD = """\
# Versions and hashes of what images and `make setup` install: CPython 3.11, Linux, x86_64. `make lock` writes this.
# The comment above a package names the packages that need it.
"""


def name_of(text: str) -> str:
    """Return the normal form of a package's name."""
    return re.sub(r"[-_.]+", "-", text).lower()


def needs(metadata: dict, extras: set[str]) -> dict[str, set[str]]:
    """Return package -> its requested extras, for a package that is installed with these extras."""
    found: dict[str, set[str]] = {}
    for line in metadata.get("requires_dist", ()):
        requirement = Requirement(line)
        if requirement.marker is None or any(requirement.marker.evaluate({"extra": extra}) for extra in ("", *extras)):
            found.setdefault(name_of(requirement.name), set()).update(requirement.extras)
    return found


def lock(report: list[dict]) -> str:
    """Return the text of the lock."""
    packages = {name_of(one["metadata"]["name"]): one for one in report}
    extras = {name: set(one.get("requested_extras", ())) for name, one in packages.items()}
    dependents: dict[str, set[str]] = {name: set() for name in packages}
    for _ in range(3):  # extras of extras
        for name, one in packages.items():
            for other, wanted in needs(one["metadata"], extras[name]).items():
                if other in packages and other != name:
                    dependents[other].add(name)
                    extras[other] |= wanted
    lines = [HEAD]
    for name, one in sorted(packages.items()):
        if name not in (OWN, *WITHOUT):
            digest = one["download_info"]["archive_info"]["hashes"]["sha256"]
            lines.append(f"# {name} <- {' '.join(sorted(dependents[name])) or '-'}\n")
            lines.append(f"{name}=={one['metadata']['version']} --hash=sha256:{digest}\n")
    return "".join(lines)


if __name__ == "__main__":
    LOCK.write_text(lock(json.loads(Path(sys.argv[1]).read_text())["install"]))
    print(f"{LOCK.name} is written.")
