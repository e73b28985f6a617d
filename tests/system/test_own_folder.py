"""Another user of the machine is first: makes the runtime folder, puts links into it, answers on a socket there."""

import os
import shutil
import socket
import sys
import tempfile
import traceback
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest

from gemuco.compiled import jit
from hal.own_folder import NotOwnFolder, own_folder
from services import health
from services.errors import ServiceError
from services.process.heartbeat import Heartbeat
from services.process.lock import ServiceLock
from services.runtime import runtime_folder
from simulators.hub import HubBus
from simulators.hub_server import HubServer
from simulators.hub_socket import BUSES, HELLOS, socket_path

STRANGER = 65534
"""`nobody` is the other user."""
OWN = os.geteuid()
needs_root = pytest.mark.skipif(OWN != 0, reason="only root can be another user for a moment")


@pytest.fixture
def shared(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A temporary directory of all users, like /tmp."""
    tmp_path_factory.getbasetemp()  # not below the directory that is removed here
    shared = Path(tempfile.mkdtemp())
    shared.chmod(0o1777)
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(shared))
    yield shared
    shutil.rmtree(shared)


def as_stranger(work: Callable[[], object]) -> None:
    """Do work as another user, to its end."""
    assert os.waitpid(begin_as_stranger(work), 0)[1] == 0


def begin_as_stranger(work: Callable[[], object], user: int = STRANGER, group: int = STRANGER) -> int:
    """Do work in a process of another user, and return its number."""
    pid = os.fork()
    if pid == 0:
        try:
            os.setgroups([])
            os.setgid(group)
            os.setuid(user)
            work()
        except BaseException:
            traceback.print_exc(file=sys.__stderr__)
            os._exit(1)
        os._exit(0)
    return pid


def own(shared: Path) -> Path:
    return shared / f"gemuco-{OWN}"


def all_refuse(text: str) -> None:
    """Every program that uses the folder refuses it in a sentence."""
    with pytest.raises(NotOwnFolder, match=text):
        own_folder()
    with pytest.raises(ServiceError, match=text):
        runtime_folder()
    with pytest.raises(ServiceError, match=text):
        ServiceLock("arm", "hal").acquire()
    with pytest.raises(ServiceError, match=text):
        Heartbeat("hal", "arm", [])
    is_healthy, sentence = health.check("hal", "arm")
    assert not is_healthy and "not safe" in sentence
    with pytest.raises(can.CanInitializationError, match=text):
        HubServer("can0")
    with pytest.raises(can.CanInitializationError, match=text):
        HubBus("can0")


@needs_root
@pytest.mark.parametrize("mode", [0o700, 0o755, 0o777])
def test_a_folder_that_another_user_made_first_is_refused(mode: int, shared: Path) -> None:
    as_stranger(lambda: (own(shared).mkdir(), own(shared).chmod(mode)))
    all_refuse(f"belongs to user {STRANGER}")


@needs_root
def test_a_link_that_another_user_made_first_is_refused(shared: Path) -> None:
    home = shared / "home"
    home.mkdir(mode=0o700)
    victim = home / "arm.hal.lock"
    victim.write_text("important")
    as_stranger(lambda: own(shared).symlink_to(home))
    all_refuse("is a link")
    assert victim.read_text() == "important"
    assert [path.name for path in home.iterdir()] == ["arm.hal.lock"]


@needs_root
def test_a_folder_below_one_of_another_user_is_refused(shared: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As after `su` with the environment of another user."""
    as_stranger(lambda: (shared / "run").mkdir(mode=0o755))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(shared / "run"))
    all_refuse(f"run' belongs to user {STRANGER}")


@needs_root
def test_others_reach_nothing_in_ones_own_folder(shared: Path) -> None:
    lock = ServiceLock("arm", "hal")
    lock.acquire()
    with HubServer("can0"), Heartbeat("hal", "arm", []):
        paths = [*own(shared).iterdir()]
        assert len(paths) == 4

        def pry() -> None:
            for path in paths:
                for flags in (os.O_RDONLY, os.O_WRONLY):
                    with pytest.raises(PermissionError):
                        os.open(path, flags)
            with pytest.raises(PermissionError):
                (own(shared) / "more").touch()
            with pytest.raises(PermissionError):
                own(shared).rename(shared / "away")
            with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as link, pytest.raises(PermissionError):
                link.connect(str(own(shared) / "can0.can"))

        as_stranger(pry)
    lock.release()


@needs_root
def test_a_bus_of_another_user_is_not_joined(shared: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = shared / "bus.can"
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    reader, writer = os.pipe()

    def serve() -> None:
        listener.bind(str(path))
        path.chmod(0o777)
        listener.listen()
        os.write(writer, b"x")
        listener.accept()  # refused
        listener.accept()[0].send(next(iter(HELLOS)))

    pid = begin_as_stranger(serve)
    os.read(reader, 1)
    with pytest.raises(can.CanInitializationError, match="a program of another user answers"):
        HubBus(str(path))
    monkeypatch.setenv(BUSES, str(shared))  # wanted, as between containers with a user each
    HubBus("bus").shutdown()
    os.waitpid(pid, 0)


def test_a_folder_that_others_could_write_to_is_refused(shared: Path) -> None:
    own(shared).mkdir()
    own(shared).chmod(0o770)
    all_refuse("can be written to by other users")


def test_a_base_that_others_could_write_to_is_refused(shared: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (shared / "run").mkdir()
    (shared / "run").chmod(0o777)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(shared / "run"))
    all_refuse("run' can be written to by other users")


def test_a_folder_that_others_could_read_is_closed(shared: Path) -> None:
    own(shared).mkdir(mode=0o755)
    assert runtime_folder().stat().st_mode & 0o777 == 0o700


def test_a_link_in_the_folder_is_not_followed(shared: Path, tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("important")
    (runtime_folder() / "arm.hal.lock").symlink_to(victim)
    (runtime_folder() / "can0.can.lock").symlink_to(victim)
    (runtime_folder() / f"arm.hal.{os.getpid()}.part").symlink_to(victim)
    with pytest.raises(ServiceError, match=r"The lock '.*arm.hal.lock' cannot be opened: Too many levels of symbolic"):
        ServiceLock("arm", "hal").acquire()
    with pytest.raises(can.CanInitializationError, match="Too many levels of symbolic links"):
        HubServer("can0").start()
    with Heartbeat("hal", "arm", []):
        assert not health.check("hal", "arm")[0]
    assert victim.read_text() == "important"


@needs_root
def test_a_bus_is_shared_between_two_users_of_one_group(shared: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As between the containers of the simulator and of the HAL (docker-compose.yml)."""
    monkeypatch.setenv(BUSES, str(shared))
    os.chown(shared, 10005, 10001)
    shared.chmod(0o750)
    reader, writer = os.pipe()
    ended, end = os.pipe()

    def serve() -> None:
        with HubServer("bus"):
            os.write(writer, b"x")
            os.read(ended, 1)

    def join() -> None:
        with pytest.raises(PermissionError):
            (shared / "more").touch()
        HubBus("bus").shutdown()

    def look() -> None:
        with pytest.raises(can.CanInitializationError, match="Permission denied"):
            HubBus("bus")

    server = begin_as_stranger(serve, 10005, 10001)
    os.read(reader, 1)
    assert os.waitpid(begin_as_stranger(join, 10002, 10001), 0)[1] == 0
    assert os.waitpid(begin_as_stranger(look), 0)[1] == 0
    os.write(end, b"x")
    assert os.waitpid(server, 0)[1] == 0


def test_shared_buses_are_for_a_group(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(BUSES, str(tmp_path))
    name = uuid.uuid4().hex[:8]
    mask = os.umask(0o077)
    try:
        with HubServer(name):
            assert socket_path(name) == tmp_path / f"{name}.can"
            assert socket_path(name).stat().st_mode & 0o777 == 0o660
    finally:
        os.umask(mask)


def test_compiled_code_is_not_taken_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    assert jit._is_own(tmp_path / "real") and not jit._is_own(tmp_path / "link")
