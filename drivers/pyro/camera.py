"""Camera: the robot's newest picture, and a row of filters that tell what is in it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from drivers.errors import BadFrame, UsageError
from drivers.pyro.device import Device
from drivers.reading import Frame, Value
from formats.jpeg import size_of

Blob = tuple[int, int, int, int, int]
"""Left, top, right and bottom in pixels from the upper left corner, and the area; all 0: none."""
Filter = Callable[["Camera"], Any]
TOLERANCE = 30
DEPTH = 3


class Camera(Device):
    """The camera; ``width`` and ``height`` in pixels, ``depth`` bytes each.

    ``addFilter`` names one of ``match`` (red, green, blue, tolerance: marks the pixels of about that colour) and
    ``blobify`` (channel, low, high, sort, size, draw, count: the largest patches of what was marked, or without a mark
    of that brightness), or is a function of this camera.  With each new picture all of them run in turn, and
    ``filterResults`` has what each has told.
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
        """The newest picture, three bytes a pixel (red, green, blue), row by row; empty before the first."""
        return b"" if self._picture() is None else bytes(self._image.tobytes())

    def addFilter(self, name: str | Filter, *arguments: float) -> None:
        """Run this filter from the next picture on, after those that are there."""
        if callable(name):
            self._filters.append((name, getattr(name, "__name__", "filter")))
            return
        if name not in ("match", "blobify"):
            raise AttributeError(f"no filter is called {name!r}; there are match and blobify, or give a function")
        self._filters.append((lambda camera: camera.apply(name, *arguments), name))

    def clearFilters(self) -> None:
        """Run none."""
        self._filters, self.filterResults = [], []

    def apply(self, name: str, *arguments: float) -> Any:
        """Run one filter now, as a function given to ``addFilter`` may do."""
        whole = [int(value) for value in arguments]
        return self._match(*whole) if name == "match" else self._blobify(*whole)

    def see(self, frame: Frame | None) -> None:
        """Take a picture, if it is a new one, and run the filters on it."""
        if frame is None or frame.seq == self._seq:
            return
        self._seq, self._frame, self._image, self._marked = frame.seq, frame, None, None
        if self._filters and self._picture() is not None:
            self.filterResults = [each(self) for each, _ in self._filters]

    def update(self, values: Mapping[str, Value], now: float) -> None:
        """Nothing of what the robot feels concerns its camera."""
        self.timestamp = now

    def _picture(self) -> Any:
        frame, self._frame = self._frame, None
        if frame is not None:
            try:
                self._image = _decoded(frame.data)
            except BadFrame:
                self.bad_pictures += 1
                return self._image
            self.pictures += 1
            self.height, self.width = self._image.shape[:2]
        return self._image

    def _match(self, red: int, green: int, blue: int, tolerance: int = TOLERANCE, *_: int) -> int:
        import numpy as np

        image = self._picture()
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

        image = self._picture()
        plane = image[:, :, channel]
        marked = (plane >= low) & (plane <= high) if self._marked is None else self._marked
        found, _, stats, _ = cv2.connectedComponentsWithStats(marked.astype(np.uint8), connectivity=8)
        rows = [tuple(int(value) for value in stats[n]) for n in range(1, found)]
        blobs = [(left, top, left + wide - 1, top + high - 1, area) for left, top, wide, high, area in rows]
        blobs.sort(key=lambda blob: -blob[4])
        return [*blobs, *[(0, 0, 0, 0, 0)] * count][:count]


def _decoded(data: bytes) -> Any:
    """The picture as rows of red, green, blue; raises ``BadFrame``, and ``UsageError`` where OpenCV is missing."""
    try:
        import cv2
        import numpy as np
    except ImportError as error:
        raise UsageError("pictures need OpenCV: pip install 'swarm-node[vision]'") from error
    picture = None if size_of(data) is None else cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise BadFrame(f"{len(data)} bytes are no picture")
    return np.ascontiguousarray(picture[:, :, ::-1])
