"""Driver of a camera, of this machine or on the network, or of a substitute source of pictures."""

from __future__ import annotations

import os
from collections.abc import Mapping
from importlib import import_module
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime

from drivers.base import SensingDriver
from drivers.camera.mjpeg import MjpegStream
from drivers.camera.option import Options, make_description, parse_options, parse_url
from drivers.camera.picture_stream import PictureStream, ThreadedStream, TimedStream
from drivers.camera.source import CaptureSource, FolderSource, JpegPicture
from drivers.link import Connector, TcpConnector
from drivers.option import Manifest
from drivers.reading import Description, Frame
from drivers.timer import Timer

MANIFEST = Manifest("cv2", "vision", "except for a folder of JPEGs or a url")


class CameraDriver(SensingDriver):
    """One camera; ``stream`` delivers its pictures."""

    def __init__(
        self, options: Options | Mapping[str, object], stream: PictureStream, clock: IReactorTime, name: str
    ) -> None:
        self._options = options if isinstance(options, Options) else parse_options(options)
        super().__init__(make_description(self._options), name, clock)
        self.STALE_S = max(0.5, 3.0 / self._options.fps)
        self._stream = stream
        self._fps = self._options.fps
        self._started_at = 0.0
        self._problem = ""
        self._idle_timer = Timer(clock)
        self._frame: Frame | None = None

    @property
    def camera_fps(self) -> float:
        """The requested frame rate in pictures per second."""
        return self._fps

    def set_camera_fps(self, fps: float) -> None:
        """Set the frame rate in pictures per second; at 0 no pictures are taken, but the device stays ready."""
        previous, self._fps = self._fps, fps
        self._stream.set_fps(fps)
        self.STALE_S = max(0.5, 3.0 / fps) if fps > 0 else 0.5
        if fps > 0:
            self._idle_timer.cancel()
        elif previous > 0 and self._is_up:
            self._report_idle()

    @property
    def problem(self) -> str:
        """The reason why no pictures arrive, and the remedy; empty if pictures arrive."""
        return self._problem

    def diagnostics(self) -> dict[str, float]:
        """The counters of every driver, and ``dropped``, the number of pictures replaced by newer pictures."""
        return {**super().diagnostics(), "dropped": float(getattr(self._stream, "dropped", 0))}

    # -- called by the stream ---------------------------------------------------------------------------------------

    def on_picture(self, picture: JpegPicture) -> None:
        """Publish a picture."""
        self._problem = ""
        self._counts["frames"] += 1
        self._counts["pictures"] += 1
        self._counts["bytes"] += len(picture.jpeg)
        if not self._is_up:
            self._up()
        t = self._clock.seconds() - self._started_at
        self._frame = Frame(self._counts["pictures"], picture.width, picture.height, picture.jpeg, t)
        self._observed({}, t, frame=self._frame)
        if self._fps <= 0 and not self._idle_timer.is_set and not self._is_closed:
            self._report_idle()

    def on_invalid_picture(self, reason: str) -> None:
        """Count an invalid picture."""
        self._counts["bad_frames"] += 1
        self.log.debug("{robot}: {reason}", robot=self._name, reason=reason)

    def on_source_lost(self, reason: str) -> None:
        """Handle the loss of the source; it is logged once, and the stream retries."""
        if reason != self._problem:
            self.log.warn("{robot}: {reason}; trying again", robot=self._name, reason=reason)
        self._problem = reason
        self._counts["refused"] += 1
        self._idle_timer.cancel()
        if self._is_up:
            self._down()

    def _open(self) -> None:
        self._started_at = self._clock.seconds()
        self._stream.start(self, self._fps)

    def _close(self) -> Deferred[None]:
        self._idle_timer.cancel()
        return self._stream.stop()

    def _report_idle(self) -> None:
        """Publish an observation that has no new picture, so that the link does not become stale at frame rate 0."""
        self._idle_timer.set(self.STALE_S / 2, self._report_idle)
        self._observed({}, self._clock.seconds() - self._started_at, frame=self._frame)


def make_driver(options: Mapping[str, object], name: str, clock: IReactorTime, connector: Any) -> CameraDriver:
    """Return a driver of a camera or a substitute source; only a camera on the network uses ``connector``."""
    wanted = parse_options(options)
    return CameraDriver(wanted, make_picture_stream(wanted, clock, connector), clock, name)


def describe(options: Mapping[str, object], name: str) -> Description:
    """Return the description of the camera that ``options`` select."""
    return make_description(parse_options(options))


def make_picture_stream(options: Options, clock: Any, connector: Connector | None = None) -> PictureStream:
    """Return the source of pictures; for a camera of this machine ``clock`` must be a reactor."""
    if options.url:
        size = options.width, options.height
        return MjpegStream(parse_url(options.url), size, TcpConnector() if connector is None else connector, clock)
    if isinstance(options.source, str) and not options.is_device and os.path.isdir(options.source):
        return TimedStream(FolderSource(options.source), clock)
    source = CaptureSource(options, lambda: import_module("cv2"))
    return ThreadedStream(source, clock.callFromThread) if options.is_device else TimedStream(source, clock)
