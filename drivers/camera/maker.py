"""Maker: what the registry asks of the kind "camera"."""

from __future__ import annotations

import os
from collections.abc import Mapping
from importlib import import_module
from typing import Any

from twisted.internet.interfaces import IReactorTime

from drivers.camera.driver import CameraDriver
from drivers.camera.option import Options, checked, described, place_of
from drivers.camera.shots import CaptureShots, FolderShots
from drivers.camera.stream import StreamFilm
from drivers.camera.thread import ClockFilm, Film, ThreadFilm
from drivers.link import Connector, TcpConnector
from drivers.reading import Description


def made(options: Mapping[str, object], name: str, clock: IReactorTime, connector: Any) -> CameraDriver:
    """A driver of a camera, or of pictures in its place; only one on the network needs a link."""
    wanted = checked(options)
    return CameraDriver(wanted, film_of(wanted, clock, connector), clock, name)


def description(options: Mapping[str, object], name: str) -> Description:
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
