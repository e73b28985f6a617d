"""A browser without a screen: speaks viser's protocol over a real websocket, and remembers what it was told."""

import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

import msgspec
import viser
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (1.0, 1.0, 1.0), "fov": 1.0, "near": 0.1,
    "far": 10.0, "image_height": 10, "image_width": 10, "look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, 0.0, 1.0),
}  # fmt: skip


class Browser:
    """One browser window on a page of this machine."""

    def __init__(self, port: int, origin: str | None = None, token: str = "") -> None:
        self._messages: dict[str, dict[str, Any]] = {}
        self.camera: list[tuple[float, ...]] = []
        """Positions that the page gave to the camera, the newest last."""
        self._socket = connect(
            f"ws://127.0.0.1:{port}/{token}", subprotocols=[f"viser-v{viser.__version__}"], origin=origin, max_size=None
        )  # type: ignore[arg-type]
        self.say(CAMERA)
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        self._socket.close()
        self._thread.join(5.0)

    def say(self, message: dict[str, Any]) -> None:
        self._socket.send(msgspec.msgpack.encode(message))

    def look(self, width: int, height: int, position: tuple[float, ...] | None = None) -> None:
        """Report the camera in a picture of this size; it stays where the page put it, or is moved by hand."""
        self.say(CAMERA | {"image_width": width, "image_height": height, "position": position or self.camera[-1]})

    def text(self) -> str:
        """All HTML of the page, one piece after the other."""
        return "\n".join(str(one.get("content", "")) for one in list(self._messages.values()))

    def labels(self) -> set[str]:
        """Labels of everything that can be pressed or filled in."""
        found = {str(one["label"]) for one in list(self._messages.values()) if "label" in one}
        return found | {option for one in list(self._messages.values()) for option in one.get("options") or ()}

    def props(self, label: str) -> dict[str, Any]:
        """Properties of a widget."""
        return self._messages[self._labelled(label)]

    def press(self, label: str) -> None:
        """Press a button."""
        self.say({"type": "GuiUpdateMessage", "uuid": self._labelled(label), "updates": {"value": True}})

    def hold(self, label: str, hz: float = 10.0) -> None:
        """Say once that a button is held."""
        self.say({"type": "GuiButtonHoldMessage", "uuid": self._labelled(label), "frequency": hz})

    def fill(self, label: str, value: Any) -> None:
        """Fill in a field, or move a slider."""
        self.say({"type": "GuiUpdateMessage", "uuid": self._labelled(label), "updates": {"value": value}})

    def until(self, happened: Callable[["Browser"], Any], within: float = 40.0) -> None:
        deadline = time.monotonic() + within
        while not happened(self):
            assert time.monotonic() < deadline, f"it did not happen; the page says {self.text()[-3000:]}"
            time.sleep(0.02)

    def _labelled(self, label: str) -> str:
        for uuid, one in list(self._messages.items()):
            if one.get("label") == label or label in (one.get("options") or ()):
                return uuid
        raise AssertionError(f"The page has no '{label}', but {sorted(self.labels())}.")

    def _read(self) -> None:
        unpack = zstandard.ZstdDecompressor()
        while True:
            try:
                data = self._socket.recv()
            except ConnectionClosed:
                return
            assert isinstance(data, bytes)
            size, packed = (int.from_bytes(data[i : i + 8], "little") for i in (0, 8))
            body = msgspec.msgpack.decode(unpack.decompress(data[16 : 16 + packed], max_output_size=size))
            for message in body["messages"]:
                self._take(message)

    def _take(self, message: dict[str, Any]) -> None:
        uuid = message.get("uuid")
        if message["type"] == "LocalStorageGetItemRequestMessage":
            answer = {"value": None, "error": None, "request_uuid": message["request_uuid"]}
            self.say({"type": "LocalStorageGetItemResponseMessage", **answer})
        elif message["type"] == "SetCameraPositionMessage":
            self.camera.append(tuple(message["position"]))
        elif message["type"] == "GuiUpdateMessage":
            self._messages.setdefault(uuid, {}).update(message["updates"])
        elif message["type"].startswith("Gui") and isinstance(message.get("props"), dict):
            self._messages.setdefault(uuid, {}).update(message["props"])
