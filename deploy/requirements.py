"""Print what pyproject.toml asks for, one requirement per line: `requirements.py [+EXTRA] [-PACKAGE] [=PACKAGE]...`

`+sim` adds an extra, `-torch` leaves a package out, `=torch` prints that one. For the Dockerfile and `make wheels`.
"""

import re
import sys
import tomllib
from pathlib import Path


def name_of(requirement: str) -> str:
    """The package's name: what stands before extras and versions."""
    return re.split(r"[\[<>=~! ]", requirement)[0].lower()


project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
words = [(word[0], word[1:].lower()) for word in sys.argv[1:]]
found = list(project["dependencies"])
for sign, extra in words:
    if sign == "+":
        found += project["optional-dependencies"][extra]
only = {name for sign, name in words if sign == "="}
without = {name for sign, name in words if sign == "-"}
unknown = (only | without) - {name_of(one) for one in found}
if unknown:
    sys.exit(f"pyproject.toml does not ask for {', '.join(sorted(unknown))}.")
print("\n".join(one for one in found if name_of(one) not in without and (not only or name_of(one) in only)))
