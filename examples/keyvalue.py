"""A key-value store in ten lines.

``python examples/keyvalue.py 7000`` starts a network.  ``... 7001 127.0.0.1:7000 colour red`` joins the network, stores
a value and continues to run.  ``... 7002 127.0.0.1:7000 colour`` joins, prints the value and exits.
"""

import sys

from peer import joined
from twisted.internet import defer, task

from middleware.entangled.record import hash_key


async def main(reactor, port, known="", key="", value=""):
    """Store a value, print a value, or only run a node, depending on the arguments."""
    node = await joined(reactor, int(port), known)
    if value:
        print("stored on", await node.put(hash_key(key), "value", value.encode()), "nodes", flush=True)
    elif key:
        return print(*[record.value.decode() for record in await node.get(hash_key(key))], flush=True)
    await defer.Deferred()


task.react(lambda reactor, *words: defer.ensureDeferred(main(reactor, *words)), sys.argv[1:])
