"""Sources of pictures: cameras, videos and folders with one interface.

A source uses no threads; ``read_picture`` is called when the next picture is wanted.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from drivers.camera.option import Options
from drivers.errors import BadFrame, LinkLost
from formats.jpeg import read_size

MAX_FILES = 10_000
MAX_PICTURE_BYTES = 4 * 1024 * 1024
"""Maximum size of a picture in bytes."""


@dataclass(frozen=True)
class JpegPicture:
    """One complete JPEG."""

    jpeg: bytes
    width: int
    height: int


class PictureSource(Protocol):
    """A source of pictures."""

    def open(self) -> None:
        """Open the source; raise ``LinkLost`` with the reason and the remedy."""

    def read_picture(self) -> JpegPicture:
        """Return the next picture; raise ``BadFrame`` for an invalid picture, ``LinkLost`` if no more pictures come."""

    def close(self) -> None:
        """Release the source; may be called in any state."""


class FolderSource:
    """The JPEGs of a folder, sorted by name, in an endless loop; OpenCV is not needed."""

    def __init__(self, folder: str) -> None:
        self._folder = Path(folder)
        self._files: list[Path] = []
        self._next = 0

    def open(self) -> None:
        """List the files."""
        try:
            every = sorted(self._folder.iterdir())
        except OSError as error:
            raise LinkLost(f"{self._folder}: {error.strerror}; source must be a folder of JPEGs") from error
        self._files = [file for file in every if file.suffix.lower() in (".jpg", ".jpeg")][:MAX_FILES]
        if not self._files:
            raise LinkLost(f"{self._folder} has no .jpg files")

    def read_picture(self) -> JpegPicture:
        """Return the next file."""
        if not self._files:
            raise LinkLost(f"{self._folder} is not open")
        file = self._files[self._next % len(self._files)]
        self._next += 1
        try:
            with file.open("rb") as opened:
                data = opened.read(MAX_PICTURE_BYTES + 1)
        except FileNotFoundError as error:
            raise LinkLost(f"{file} was deleted; reading the folder again") from error
        except OSError as error:
            raise BadFrame(f"{file}: {error.strerror}") from error
        size = read_size(data)
        if size is None or len(data) > MAX_PICTURE_BYTES:
            raise BadFrame(f"{file} is not a complete JPEG of at most {MAX_PICTURE_BYTES} bytes")
        return JpegPicture(data, *size)

    def close(self) -> None:
        """Discard the list of files; the next ``open`` continues with the next file."""
        self._files = []


class CaptureSource:
    """A camera or a video through OpenCV; ``cv2`` imports and returns that module."""

    def __init__(self, options: Options, cv2: Callable[[], Any]) -> None:
        self._options = options
        self._import_cv2 = cv2
        self._cv2: Any = None
        self._capture: Any = None

    def open(self) -> None:
        """Open the camera, or the video from its start."""
        options, source = self._options, self._options.source
        if self._cv2 is None:
            try:
                self._cv2 = self._import_cv2()
            except ImportError as error:
                raise LinkLost('OpenCV is not installed: install swarm-node with the extra "vision"') from error
        name = f"{source}" if isinstance(source, str) else f"/dev/video{source}"
        if not options.is_device and not os.path.isfile(name):
            raise LinkLost(f"{name}: no such video file or folder of JPEGs exists; correct the option source")
        if name.startswith("/dev/"):
            if not os.path.exists(name):
                raise LinkLost(f"{name}: no such camera exists; is it plugged in?")
            if not os.access(name, os.R_OK | os.W_OK):
                raise LinkLost(f"{name}: no permission; add this user to the group video")
            source = int(name.removeprefix("/dev/video")) if name.removeprefix("/dev/video").isdecimal() else name
        capture = self._cv2.VideoCapture(source)
        if not capture.isOpened():
            capture.release()
            raise LinkLost(f"{name} cannot be opened; another program may be using it, or it contains no pictures")
        if options.is_device:
            capture.set(self._cv2.CAP_PROP_FRAME_WIDTH, options.width)
            capture.set(self._cv2.CAP_PROP_FRAME_HEIGHT, options.height)
            capture.set(self._cv2.CAP_PROP_BUFFERSIZE, 1)
        self._capture = capture

    def read_picture(self) -> JpegPicture:
        """Return the camera's next picture, or the next picture of the video, which restarts at its end."""
        if self._capture is None:
            raise LinkLost("it is not open")
        is_read, picture = self._capture.read()
        if not is_read and not self._options.is_device:
            self._capture.set(self._cv2.CAP_PROP_POS_FRAMES, 0)
            is_read, picture = self._capture.read()
        if not is_read or picture is None:
            raise LinkLost(f"{self._options.source}: no more pictures come; was it unplugged?")
        if picture.shape[1] > self._options.width or picture.shape[0] > self._options.height:
            scale = min(self._options.width / picture.shape[1], self._options.height / picture.shape[0])
            size = (max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale)))
            picture = self._cv2.resize(picture, size, interpolation=self._cv2.INTER_AREA)
        is_encoded, jpeg = self._cv2.imencode(".jpg", picture, [self._cv2.IMWRITE_JPEG_QUALITY, self._options.quality])
        if not is_encoded:
            raise BadFrame("a picture could not be encoded as JPEG")
        return JpegPicture(jpeg.tobytes(), picture.shape[1], picture.shape[0])

    def close(self) -> None:
        """Release the camera for other programs."""
        if self._capture is not None:
            self._capture.release()
        self._capture = None
