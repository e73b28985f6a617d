"""Print what pyproject.toml asks for: `requirements.py [--locked] [+EXTRA] [-PACKAGE] [=PACKAGE]...`, one per line.

`+sim` adds an extra, `+build` what builds this package; `-torch` leaves a package out, `=torch` prints that one. With
`--locked` it prints all packages that these need too, with the versions and hashes of requirements.lock. For the
Dockerfile, `make setup` and `make wheels`.
"""

import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
FILE = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT = FILE["project"]
EXTRAS = {**PROJECT["optional-dependencies"], "build": FILE["build-system"]["requires"]}


def name_of(requirement: str) -> str:
    """Return the normal form of the name of a package, without extras and versions."""
    return re.sub(r"[-_.]+", "-", re.split(r"[\[<>=~! ]", requirement)[0]).lower()


def of_extra(extra: str) -> list[str]:
    """Return the requirements of an extra, and of the extras that it names."""
    found = []
    for requirement in EXTRAS[extra]:
        if name_of(requirement) == PROJECT["name"]:
            inner = re.findall(r"\[(.*)\]", requirement)[0]
            found += [line for name in inner.split(",") for line in of_extra(name)]
        else:
            found.append(requirement)
    return found


def locked(names: set[str], without: set[str]) -> list[str]:
    """Return the entries of the lock for these packages and for all that they need."""
    entries = re.findall(r"^# (\S+) <- (.*)\n(.+)\n", (ROOT / "requirements.lock").read_text(), re.M)
    found, before = set(names), set()
    while found != before:
        before = set(found)
        found |= {name for name, needed_by, _ in entries if found & set(needed_by.split())} - without
    return [text for name, _, text in entries if name in found]


def main(words: list[str]) -> None:
    """Print the requirements for these words."""
    is_locked = "--locked" in words
    signs = [(word[0], word[1:].lower()) for word in words if word != "--locked"]
    requirements = list(PROJECT["dependencies"])
    for sign, extra in signs:
        if sign == "+":
            requirements += of_extra(extra)
    only = {name for sign, name in signs if sign == "="}
    without = {name for sign, name in signs if sign == "-"}
    names = {requirement: name_of(requirement) for requirement in requirements}
    if unknown := (only | without) - set(names.values()):
        sys.exit(f"pyproject.toml does not ask for {', '.join(sorted(unknown))}.")
    chosen = [r for r, name in names.items() if name not in without and (not only or name in only)]
    print("\n".join(locked({names[r] for r in chosen}, without) if is_locked else dict.fromkeys(chosen)))


if __name__ == "__main__":
    main(sys.argv[1:])
