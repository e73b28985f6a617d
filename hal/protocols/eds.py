"""EDS and DCF files as vendors ship them: any encoding, and without some entries that CiA 306 wants."""

import io
import re
from configparser import RawConfigParser
from pathlib import Path
from typing import Any

import canopen
from canopen.objectdictionary import ODVariable

from hal.errors import ConfigError

SUFFIXES = (".eds", ".dcf")
_OBJECT = re.compile(r"[0-9A-Fa-f]{4}(?:[Ss]ub[0-9A-Fa-f]+)?")
_VARIABLE = ("", "7", "0x7", "0x07", "0x0007", "2", "0x2", "0x02", "0x0002")
"""Types of an object (VAR, DOMAIN) that has a value itself."""
_NUMBERS = ("VendorNumber", "ProductNumber", "RevisionNumber", "NrOfRXPDO", "NrOfTXPDO", "Granularity")


def read_sheet(path: Path, node: int | None = None) -> canopen.ObjectDictionary:
    """Read an EDS or DCF file.

    Args:
        path: The file.
        node: Node id that is added to relative defaults; that of a DCF file if None.

    Raises:
        ConfigError: It is missing or no such file.
    """
    if not path.is_file():
        raise ConfigError(f"There is no EDS file '{path}'. The path is relative to the folder of the robot file.")
    try:
        return _read(path, node)
    except Exception as error:  # canopen passes on every exception of its parser
        reason = " ".join(str(error).split()).rstrip(".")
        raise ConfigError(f"'{path}' is not an EDS file that canopen can read: {reason}.") from error


def _read(path: Path, node: int | None) -> canopen.ObjectDictionary:
    if path.suffix.lower() not in SUFFIXES:
        return canopen.import_od(str(path), node_id=node)
    file = _parsed(_decoded(path.read_bytes()))
    _complete(file)
    text = io.StringIO()
    file.write(text)
    source: Any = io.StringIO(text.getvalue())
    source.name = path.name.lower()
    return canopen.import_od(source, node_id=node)


def value_of(variable: ODVariable) -> int | float | str | bytes | None:
    """Return the value of a configured device (ParameterValue of a DCF), or else the default; None without both."""
    value: int | float | str | bytes | None = variable.default if variable.value is None else variable.value
    return value


def is_relative(variable: ODVariable) -> bool:
    """Whether the node id is added to the value of `value_of`."""
    if variable.value is None:
        return bool(variable.relative)
    return "$NODEID" in str(getattr(variable, "value_raw", "")).upper()


def _decoded(data: bytes) -> str:
    """Return text: UTF-8 if it is, otherwise the code page that most tools for EDS files write."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", "replace")


def _parsed(text: str) -> RawConfigParser:
    file = RawConfigParser(inline_comment_prefixes=(";",), strict=False, allow_no_value=True)
    file.optionxform = str  # type: ignore[assignment, method-assign]
    file.read_string(text)
    if not file.has_section("DeviceInfo") and not any(_OBJECT.fullmatch(section) for section in file.sections()):
        raise ValueError("it has neither [DeviceInfo] nor an object such as [1000]")
    return file


def _complete(file: RawConfigParser) -> None:
    """Add what canopen insists on; remove empty entries, and comments, whose lines need not be as many as they say."""
    file.remove_section("Comments")
    for section in file.sections():
        for option, value in file.items(section):
            if value is None or not value.strip():
                file.remove_option(section, option)
    if file.has_section("DeviceInfo"):
        for option in _NUMBERS:
            if not _is_number(file.get("DeviceInfo", option, fallback="0")):
                file.remove_option("DeviceInfo", option)
    for section in file.sections():
        if section.lower() == "dummyusage":
            for number in range(1, 8):
                if not file.has_option(section, f"Dummy{number:04d}"):
                    file.set(section, f"Dummy{number:04d}", "0")
        if not _OBJECT.fullmatch(section):
            continue
        if not file.has_option(section, "ParameterName"):
            file.set(section, "ParameterName", f"Object {section}")
        if file.get(section, "ObjectType", fallback="").strip().lower() in _VARIABLE:
            if not file.has_option(section, "DataType"):
                file.remove_section(section)
            elif not file.has_option(section, "AccessType"):
                file.set(section, "AccessType", "ro")


def _is_number(text: str) -> bool:
    try:
        int(text, 0)
    except ValueError:
        return False
    return True
