"""Chat over the tuple space: each line is put as one tuple per receiver, and each participant takes the tuples for it.

``python examples/chat.py --port 7000 ann``, and in another terminal ``... --port 7001 --known 127.0.0.1:7000 bob``.
Type lines; end with Ctrl-C or Ctrl-D.
"""

from __future__ import annotations

import argparse
import random
from typing import Any

from peer import joined
from twisted.internet import defer, stdio, task
from twisted.protocols.basic import LineReceiver

from middleware.entangled.control.conversion import remove_control_characters
from middleware.entangled.space.tuplespace import TupleSpace

LINE_TTL_S = 60.0
"""Time after which a line that was not delivered expires, in seconds."""


class Keyboard(LineReceiver):
    """Sends typed lines to all other participants."""

    delimiter = b"\n"

    def __init__(self, space: TupleSpace, name: str, ended: defer.Deferred[None]) -> None:
        self._space, self._name, self._ended = space, name, ended

    def lineReceived(self, line: bytes) -> None:
        """Send a line."""
        defer.ensureDeferred(self._send_line(line.decode(errors="replace")))

    def connectionLost(self, reason: object = None) -> None:
        """End the program when the input ends."""
        if not self._ended.called:
            self._ended.callback(None)

    async def _send_line(self, text: str) -> None:
        for _, other in await self._space.read_all(("here", str)):
            if other != self._name:
                await self._space.put(("line", other, self._name, text[:400]), ttl=LINE_TTL_S)


async def _listen(space: TupleSpace, name: str) -> None:
    while True:
        _, _, speaker, text = await space.get(("line", name, str, str))
        print(remove_control_characters(f"{speaker}: {text}"), flush=True)


async def main(reactor: Any, port: int, known: str, name: str) -> None:
    """Chat until the input ends."""
    node = await joined(reactor, port, known)
    space = TupleSpace(node, reactor, random.SystemRandom())
    await space.put(("here", name))
    here = sorted(other for _, other in await space.read_all(("here", str)))
    print("here:", *map(remove_control_characters, here), flush=True)
    ended: defer.Deferred[None] = defer.Deferred()
    stdio.StandardIO(Keyboard(space, name, ended))
    listening = defer.ensureDeferred(_listen(space, name))
    listening.addErrback(lambda failure: None)
    await ended
    await space.get_if_exists(("here", name))
    space.stop()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--port", type=int, default=0)
    parser.add_argument("--known", default="", metavar="HOST:PORT")
    parser.add_argument("name")
    args = parser.parse_args()
    task.react(lambda reactor: defer.ensureDeferred(main(reactor, args.port, args.known, args.name)))
