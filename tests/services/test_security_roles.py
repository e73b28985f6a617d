import inspect
import re
from pathlib import Path

import pytest

from services.errors import ServiceError
from services.wire import keys
from services.wire.member import Member, member_in, member_of
from services.wire.roles import OPEN, ROLES

_NOUNS = [
    name
    for name, function in inspect.getmembers(keys, inspect.isfunction)
    if list(inspect.signature(function).parameters) == ["robot"] and name not in ("everything",)
]


def _rest(key: str) -> str:
    return "/".join(keys.parse(key)[1:])


@pytest.mark.parametrize("name", _NOUNS)
def test_every_noun_of_the_key_space_has_somebody_who_says_it_and_one_who_hears_it(name: str) -> None:
    noun = _rest(getattr(keys, name)("r"))
    assert [role for role in ROLES.values() if role.may_publish(noun)]
    assert [role for role in ROLES.values() if role.may_subscribe(noun) and role.name != "recorder"]


def test_every_service_has_a_role_that_tells_its_status() -> None:
    for service in keys.SERVICES:
        role = ROLES[service]
        assert role.may_publish(f"{service}/status") and role.alive == (f"{service}/alive",)
        assert [other for other in keys.SERVICES if role.may_publish(f"{other}/status")] == [service]


def test_only_who_may_commands() -> None:
    assert [name for name, role in ROLES.items() if role.may_publish("hal/command")] == ["model", "operator"]
    assert [name for name, role in ROLES.items() if role.may_publish("model/target")] == ["operator"]
    assert [name for name, role in ROLES.items() if role.may_ask("hal", "enable")] == ["model", "operator"]
    assert [name for name, role in ROLES.items() if role.may_ask("model", "engage")] == ["operator"]


def test_a_viewer_sees_and_says_nothing() -> None:
    viewer = ROLES["viewer"]
    assert all(viewer.may_subscribe(noun) for noun in OPEN)
    assert not viewer.publishes and not viewer.answers and not viewer.alive
    assert not viewer.may_subscribe("hal/command") and not viewer.may_subscribe("**")
    for verb in ("enable", "stop", "estop", "lease", "reset", "tare", "home", "release"):
        assert not viewer.may_ask("hal", verb)


def test_who_has_no_role_file_may_everything(tmp_path: Path) -> None:
    nobody = member_of(["tcp/127.0.0.1:1"])
    assert nobody == Member() and nobody.may_ask("r", "hal", "enable") and nobody.may_publish("r", "hal/command")
    file = tmp_path / "plain.json"
    file.write_text("{}")
    assert member_of([str(file)]) == Member()


def test_a_role_is_for_its_robots(tmp_path: Path) -> None:
    file = tmp_path / "operator.json"
    file.write_text('{"metadata": {"gemuco": {"role": "operator", "robots": ["a"]}}}')
    operator = member_of([str(file)])
    assert operator.may_ask("a", "hal", "enable") and not operator.may_ask("b", "hal", "enable")
    assert operator.may_publish("a", "hal/command") and not operator.may_subscribe("b", "hal/sample")
    assert Member("viewer", ("*",)).may_subscribe("b", "hal/sample")
    assert not Member("gardener", ("*",)).may_subscribe("b", "hal/sample")


@pytest.mark.parametrize("report", ['"viewer"', '{"role": 1, "robots": []}', '{"role": "viewer"}'])
def test_metadata_that_says_no_role_is_told(tmp_path: Path, report: str) -> None:
    file = tmp_path / "viewer.json"
    file.write_text(f'{{"metadata": {{"gemuco": {report}}}}}')
    with pytest.raises(ServiceError, match=r"must be \{role: NAME, robots"):
        member_of([str(file)])


def test_no_metadata_is_no_role() -> None:
    assert member_in({}) == Member() and member_in({"metadata": {"other": 1}}) == Member()


def test_the_documents_table_is_the_table() -> None:
    text = (Path(__file__).parents[2] / "docs" / "security.md").read_text()
    for role in ROLES.values():
        row = next(line for line in text.splitlines() if line.startswith(f"| {role.name}: "))
        cells = row.split("|")[2:5]
        for names, cell in zip((role.publishes, role.subscribes, role.asks), cells, strict=True):
            report = set(re.findall(r"`([^`]+)`", cell)) | (set(OPEN) if "*open*" in cell else set())
            assert report == set(names)
