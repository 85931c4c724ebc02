"""The robot's newest picture, and a list of filters that analyse it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from drivers.errors import BadFrame, UsageError
from drivers.pyro.device import Device
from drivers.reading import Frame, Value
from formats.jpeg import read_size

Blob = tuple[int, int, int, int, int]
"""Left, top, right and bottom in pixels from the upper left corner, and the area; all 0 if no blob was found."""
Filter = Callable[["Camera"], Any]
TOLERANCE = 30
DEPTH = 3


class Camera(Device):
    """The camera; ``width`` and ``height`` in pixels, ``depth`` bytes per pixel.

    ``addFilter`` accepts one of two names or a function of this camera. ``match`` (red, green, blue, tolerance) marks
    pixels of about that colour. ``blobify`` (channel, low, high, sort, size, draw, count) finds the largest blobs of
    marked pixels, or of pixels of that brightness if none are marked. All filters run on each new picture, and
    ``filterResults`` contains their results.
    """

    depth = DEPTH

    def __init__(self, width: int, height: int) -> None:
        super().__init__("camera")
        self.width, self.height = width, height
        self.filterResults: list[Any] = []
        self.pictures = self.bad_pictures = 0
        self._filters: list[tuple[Filter, str]] = []
        self._seq: int | None = None
        self._frame: Frame | None = None
        self._image: Any = None
        self._marked: Any = None

    @property
    def data(self) -> bytes:
        """The newest picture, three bytes per pixel (red, green, blue), row by row; empty before the first picture."""
        return b"" if self._load_picture() is None else bytes(self._image.tobytes())

    def addFilter(self, name: str | Filter, *arguments: float) -> None:
        """Append a filter, which runs from the next picture on."""
        if callable(name):
            self._filters.append((name, getattr(name, "__name__", "filter")))
            return
        if name not in ("match", "blobify"):
            raise AttributeError(f"unknown filter {name!r}; known are match and blobify, or pass a function")
        self._filters.append((lambda camera: camera.apply(name, *arguments), name))

    def clearFilters(self) -> None:
        """Remove all filters."""
        self._filters, self.filterResults = [], []

    def apply(self, name: str, *arguments: float) -> Any:
        """Run one filter now; a function that was given to ``addFilter`` may call this."""
        whole = [int(value) for value in arguments]
        return self._match(*whole) if name == "match" else self._blobify(*whole)

    def process_frame(self, frame: Frame | None) -> None:
        """Store a picture if it is new, and run the filters on it."""
        if frame is None or frame.seq == self._seq:
            return
        self._seq, self._frame, self._image, self._marked = frame.seq, frame, None, None
        if self._filters and self._load_picture() is not None:
            self.filterResults = [each(self) for each, _ in self._filters]

    def update(self, values: Mapping[str, Value], now: float) -> None:
        """Ignore the sensor values; a camera has none."""
        self.timestamp = now

    def _load_picture(self) -> Any:
        frame, self._frame = self._frame, None
        if frame is not None:
            try:
                self._image = _decode_picture(frame.data)
            except BadFrame:
                self.bad_pictures += 1
                return self._image
            self.pictures += 1
            self.height, self.width = self._image.shape[:2]
        return self._image

    def _match(self, red: int, green: int, blue: int, tolerance: int = TOLERANCE, *_: int) -> int:
        import numpy as np

        image = self._load_picture()
        off = np.abs(image.astype(np.int16) - np.array((red, green, blue), np.int16))
        matching = (off <= tolerance).all(axis=2)
        self._marked = matching if self._marked is None else self._marked | matching
        return int(matching.sum())

    def _blobify(
        self,
        channel: int = 0,
        low: int = 255,
        high: int = 255,
        _sort: int = 0,
        _size: int = 0,
        _draw: int = 0,
        count: int = 1,
        *_: int,
    ) -> list[Blob]:
        import cv2
        import numpy as np

        image = self._load_picture()
        plane = image[:, :, channel]
        marked = (plane >= low) & (plane <= high) if self._marked is None else self._marked
        found, _, stats, _ = cv2.connectedComponentsWithStats(marked.astype(np.uint8), connectivity=8)
        rows = [tuple(int(value) for value in stats[n]) for n in range(1, found)]
        blobs = [(left, top, left + wide - 1, top + high - 1, area) for left, top, wide, high, area in rows]
        blobs.sort(key=lambda blob: -blob[4])
        return [*blobs, *[(0, 0, 0, 0, 0)] * count][:count]


def _decode_picture(data: bytes) -> Any:
    """Decode a picture to rows of red, green, blue.

    Raises ``BadFrame`` for an invalid picture and ``UsageError`` if OpenCV is missing.
    """
    try:
        import cv2
        import numpy as np
    except ImportError as error:
        raise UsageError("pictures need OpenCV: pip install 'swarm-node[vision]'") from error
    picture = None if read_size(data) is None else cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise BadFrame(f"{len(data)} bytes are not a picture")
    return np.ascontiguousarray(picture[:, :, ::-1])
