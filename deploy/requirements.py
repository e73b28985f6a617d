"""Print what pyproject.toml asks for, one requirement per line: `requirements.py [+EXTRA] [-PACKAGE] [=PACKAGE]...`

`+sim` adds an extra, `-torch` leaves a package out, `=torch` prints that one. For the Dockerfile and `make wheels`.
"""

import re
import sys
import tomllib
from pathlib import Path


def name_of(requirement: str) -> str:
    """Return the name of a package without extras and versions."""
    return re.split(r"[\[<>=~! ]", requirement)[0].lower()


project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
words = [(word[0], word[1:].lower()) for word in sys.argv[1:]]
requirements = list(project["dependencies"])
for sign, extra in words:
    if sign == "+":
        requirements += project["optional-dependencies"][extra]
only = {name for sign, name in words if sign == "="}
without = {name for sign, name in words if sign == "-"}
unknown = (only | without) - {name_of(requirement) for requirement in requirements}
if unknown:
    sys.exit(f"pyproject.toml does not ask for {', '.join(sorted(unknown))}.")
names = {requirement: name_of(requirement) for requirement in requirements}
print("\n".join(r for r, name in names.items() if name not in without and (not only or name in only)))
