"""CameraDriver: a camera, of this machine or on the network, or pictures in its place.

It senses, and moves as whoever holds it does.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from importlib import import_module
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime

from drivers.base import SensingDriver
from drivers.camera.option import Options, checked, described, place_of
from drivers.camera.shots import CaptureShots, FolderShots, Shot
from drivers.camera.stream import StreamFilm
from drivers.camera.thread import ClockFilm, Film, ThreadFilm
from drivers.link import Connector, TcpConnector
from drivers.option import Manifest
from drivers.reading import Description, Frame
from drivers.timer import Timer

MANIFEST = Manifest("cv2", "vision", "but for a folder of JPEGs or an address")


class CameraDriver(SensingDriver):
    """One camera, whose pictures ``film`` brings."""

    def __init__(self, options: Options | Mapping[str, object], film: Film, clock: IReactorTime, name: str) -> None:
        self._options = options if isinstance(options, Options) else checked(options)
        super().__init__(described(self._options), name, clock)
        self.STALE_S = max(0.5, 3.0 / self._options.fps)
        self._film = film
        self._fps = self._options.fps
        self._began = 0.0
        self._told = ""
        self._beat = Timer(clock)
        self._frame: Frame | None = None

    @property
    def camera_fps(self) -> float:
        """Pictures a second that the camera is asked for."""
        return self._fps

    def set_camera_fps(self, fps: float) -> None:
        """Take so many pictures a second from now on; 0: none, and then the device is ready all the same."""
        was, self._fps = self._fps, fps
        self._film.set_fps(fps)
        self.STALE_S = max(0.5, 3.0 / fps) if fps > 0 else 0.5
        if fps > 0:
            self._beat.cancel()
        elif was > 0 and self._is_up:
            self._rest_camera()

    @property
    def problem(self) -> str:
        """Why there are no pictures, and the remedy; empty where there are."""
        return self._told

    def diagnostics(self) -> dict[str, float]:
        """As every driver's; and ``dropped``, the pictures that gave way to newer ones."""
        return {**super().diagnostics(), "dropped": float(getattr(self._film, "dropped", 0))}

    # -- told by the film -------------------------------------------------------------------------------------------

    def shown(self, shot: Shot) -> None:
        """Take a picture."""
        self._told = ""
        self._counts["frames"] += 1
        self._counts["pictures"] += 1
        self._counts["bytes"] += len(shot.jpeg)
        if not self._is_up:
            self._up()
        t = self._clock.seconds() - self._began
        self._frame = Frame(self._counts["pictures"], shot.width, shot.height, shot.jpeg, t)
        self._observed({}, t, frame=self._frame)
        if self._fps <= 0 and not self._beat.is_set and not self._is_closed:
            self._rest_camera()

    def spoilt(self, reason: str) -> None:
        """Count a picture that was none."""
        self._counts["bad_frames"] += 1
        self.log.debug("{robot}: {reason}", robot=self._name, reason=reason)

    def gone(self, reason: str) -> None:
        """Learn that there are no pictures; it is told once, and tried again."""
        if reason != self._told:
            self.log.warn("{robot}: {reason}; trying again", robot=self._name, reason=reason)
        self._told = reason
        self._counts["refused"] += 1
        self._beat.cancel()
        if self._is_up:
            self._down()

    def _open(self) -> None:
        self._began = self._clock.seconds()
        self._film.start(self, self._fps)

    def _close(self) -> Deferred[None]:
        self._beat.cancel()
        return self._film.stop()

    def _rest_camera(self) -> None:
        """While no pictures are wanted, say that the device is there, or it would count as lost."""
        self._beat.set(self.STALE_S / 2, self._rest_camera)
        self._observed({}, self._clock.seconds() - self._began, frame=self._frame)


def make_driver(options: Mapping[str, object], name: str, clock: IReactorTime, connector: Any) -> CameraDriver:
    """A driver of a camera, or of pictures in its place; only one on the network needs a link."""
    wanted = checked(options)
    return CameraDriver(wanted, film_of(wanted, clock, connector), clock, name)


def describe(options: Mapping[str, object], name: str) -> Description:
    """What that camera is."""
    return described(checked(options))


def film_of(options: Options, clock: Any, connector: Connector | None = None) -> Film:
    """Where the pictures come from; a camera brings them to the thread of ``clock``, which then is a reactor."""
    if options.url:
        size = options.width, options.height
        return StreamFilm(place_of(options.url), size, TcpConnector() if connector is None else connector, clock)
    if isinstance(options.source, str) and not options.is_device and os.path.isdir(options.source):
        return ClockFilm(FolderShots(options.source), clock)
    shots = CaptureShots(options, lambda: import_module("cv2"))
    return ThreadFilm(shots, clock.callFromThread) if options.is_device else ClockFilm(shots, clock)
