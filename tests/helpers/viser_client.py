"""A client of viser's without a screen: sends a camera, and collects the images that a browser would show behind it."""

import io
from types import TracebackType
from typing import Any, Self

import msgspec
import numpy as np
import viser
import zstandard
from PIL import Image
from websockets.sync.client import ClientConnection, connect

SECONDS = 0.01  # for a message to be there


class Client:
    """One connection; a context manager."""

    def __init__(self, port: int) -> None:
        protocol: Any = f"viser-v{viser.__version__}"
        self._socket: ClientConnection = connect(
            f"ws://127.0.0.1:{port}", subprotocols=[protocol], max_size=None, proxy=None
        )
        self.images: list[np.ndarray] = []
        self.panel: dict[str, Any] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._socket.close()

    def look(self, wxyz: Any, position: Any, fov: float, size: tuple[int, int]) -> None:
        """Have a camera, width x height pixels large."""
        self._send(
            type="ViewerCameraMessage",
            wxyz=list(wxyz),
            position=list(position),
            fov=fov,
            near=0.01,
            far=1000.0,
            image_height=size[1],
            image_width=size[0],
            look_at=[0.0, 0.0, 1.0],
            up_direction=[0.0, -1.0, 0.0],
        )

    def change(self, label: str, value: Any) -> None:
        """Change what an element of the panel holds, or press a button."""
        self._send(type="GuiUpdateMessage", uuid=self.panel[label], updates={"value": value})

    def _send(self, **message: Any) -> None:
        self._socket.send(msgspec.msgpack.encode(message))

    def receive(self) -> list[dict[str, Any]]:
        """Take what has come; images and elements of the panel are kept."""
        messages: list[dict[str, Any]] = []
        while True:
            try:
                data = self._socket.recv(timeout=SECONDS)
            except TimeoutError:
                return messages
            assert isinstance(data, bytes)
            length = int.from_bytes(data[8:16], "little")
            window = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(data[16 : 16 + length]))
            for message in window["messages"]:
                messages.append(message)
                label = message.get("props", {}).get("label") if isinstance(message.get("props"), dict) else None
                if label is not None:
                    self.panel[label] = message["uuid"]
                if message["type"] == "BackgroundImageMessage" and message["rgb_data"] is not None:
                    with Image.open(io.BytesIO(message["rgb_data"])) as image:
                        self.images.append(np.asarray(image.convert("RGB")))
