"""Write the software bill of materials of an image as CycloneDX 1.5: `sbom.py OUT FOLDER...` for folders of packages.

It lists the Python packages in the folders with licence and the hash of their list of files, the packages of Debian in
the image, and Python itself. For the Dockerfile.
"""

import hashlib
import json
import platform
import re
import sys
from importlib.metadata import Distribution, distributions
from pathlib import Path
from typing import Any

DPKG = Path("/var/lib/dpkg/status")


def of_python(distribution: Distribution) -> dict[str, Any]:
    """Return the component of a Python package."""
    name, version = re.sub(r"[-_.]+", "-", distribution.metadata["Name"]).lower(), distribution.version
    licence = distribution.metadata.get("License-Expression") or distribution.metadata.get("License") or ""
    record = distribution.read_text("RECORD") or ""
    component: dict[str, Any] = {
        "type": "library",
        "name": name,
        "version": version,
        "purl": f"pkg:pypi/{name}@{version.replace('+', '%2B')}",
        "hashes": [{"alg": "SHA-256", "content": hashlib.sha256(record.encode()).hexdigest()}],
        "properties": [{"name": "gemuco:hash-of", "value": "RECORD"}],
    }
    if licence:
        component["licenses"] = [{"license": {"name": licence.splitlines()[0][:80]}}]
    return component


def of_debian(text: str) -> list[dict[str, Any]]:
    """Return the components of the installed packages in dpkg's status file."""
    found = []
    for block in text.split("\n\n"):
        fields = dict(re.findall(r"^(Package|Version|Status|Architecture): (.*)$", block, re.M))
        if fields.get("Status", "").endswith(" installed"):
            name, version = fields["Package"], fields["Version"]
            purl = f"pkg:deb/debian/{name}@{version.replace('+', '%2B')}?arch={fields['Architecture']}"
            found.append({"type": "library", "name": name, "version": version, "purl": purl})
    return found


def bill(folders: list[str], debian: str) -> dict[str, Any]:
    """Return the bill of materials of folders of Python packages and of dpkg's status."""
    python = {component["purl"]: component for one in distributions(path=folders) for component in [of_python(one)]}
    runtime = {"type": "platform", "name": "cpython", "version": platform.python_version()}
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "components": [runtime, *sorted(python.values(), key=lambda one: one["name"]), *of_debian(debian)],
    }


if __name__ == "__main__":
    content = bill(sys.argv[2:], DPKG.read_text() if DPKG.exists() else "")
    Path(sys.argv[1]).write_text(json.dumps(content, indent=1) + "\n")
    print(f"{len(content['components'])} components in {sys.argv[1]}.")
