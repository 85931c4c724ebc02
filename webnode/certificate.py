"""Certificate: the page over TLS."""

from __future__ import annotations

from collections.abc import Sequence

from webnode.ground import Ground
from webnode.server import Door


def doors(ground: Ground) -> Sequence[Door]:
    """The further ports of the page; none, as it is served without TLS so far."""
    return ()
