"""Camera: the dog's pictures, over TCP or over datagrams that have to be asked for."""

from __future__ import annotations

from collections.abc import Callable

from twisted.internet.defer import Deferred, succeed
from twisted.internet.interfaces import IReactorTime

from drivers.aibo.link import Datagrams, Port
from drivers.aibo.picture import REQUEST, Closing, Message, Picture, PictureReader, decoded
from drivers.errors import BadFrame
from drivers.link import Connector, Link
from drivers.timer import Timer

ASK_S = 0.5
"""The request for datagrams is sent so often until the first arrives, and again when they cease."""
SILENT_S = 2.0


class Camera:
    """Hands each whole picture to ``seen``; what is none is counted in ``bad_frames``."""

    def __init__(
        self,
        connector: Connector,
        clock: IReactorTime,
        address: tuple[str, int],
        seen: Callable[[Picture], None],
        datagrams: Datagrams | None = None,
    ) -> None:
        self.bad_frames = 0
        self.bytes = 0
        self.port = Port(connector, clock, address, self._on_up, lambda: None, self._on_bytes)
        self._clock = clock
        self._address = address
        self._seen = seen
        self._datagrams = datagrams
        self._reader = PictureReader()
        self._link: Link | None = None
        self._ask = Timer(clock)
        self._heard_at = -SILENT_S

    @property
    def is_silent(self) -> bool:
        """Whether datagrams are asked for, and none has come for a while."""
        return self._link is not None and self._clock.seconds() - self._heard_at >= SILENT_S

    def open(self) -> None:
        """Begin to fetch pictures; does nothing where it has begun."""
        if self._datagrams is None:
            self.port.open()
        elif self._link is None:
            self._link = self._datagrams.open(*self._address, self._on_datagram)
            self._keep_asking()

    def close(self) -> Deferred[None]:
        """Fetch no more; it can be opened again."""
        self._ask.cancel()
        link, self._link = self._link, None
        if link is not None:
            link.close()
        return self.port.close() if self._datagrams is None else succeed(None)

    def _on_up(self) -> None:
        self._reader = PictureReader()

    def _on_bytes(self, data: bytes) -> None:
        self.bytes += len(data)
        reader = self._reader
        before = reader.bad_frames
        for message in reader.read(data):
            self._on_message(message)
        self.bad_frames += reader.bad_frames - before

    def _on_datagram(self, data: bytes) -> None:
        if self._link is None:
            return
        self.bytes += len(data)
        self._heard_at = self._clock.seconds()
        try:
            message = decoded(data)
        except BadFrame:
            self.bad_frames += 1
            return
        self._on_message(message)

    def _on_message(self, message: Message) -> None:
        if isinstance(message, Picture):
            self._seen(message)
        elif isinstance(message, Closing):
            self._heard_at = -SILENT_S
            self.port.drop()

    def _keep_asking(self) -> None:
        self._ask.set(ASK_S, self._keep_asking)
        if self._link is not None and self.is_silent:
            self._link.send(REQUEST)
