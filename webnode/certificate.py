"""Certificate: the page over TLS."""

from __future__ import annotations

from collections.abc import Sequence

from twisted.logger import Logger

from webnode.ground import Ground
from webnode.server import Door

_log = Logger()


def doors(ground: Ground) -> Sequence[Door]:
    """The further ports of the page; none, as it is served without TLS so far."""
    if ground.settings.web.tls:
        _log.warn("[web] tls: the page is served without TLS")
    return ()
