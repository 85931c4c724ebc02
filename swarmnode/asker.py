"""Access of a command to the network, through the control socket of a node on this machine."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

from middleware.directory.presence import DEVICES, Device, devices_of
from middleware.entangled.control import word
from middleware.entangled.control.command import Ask
from middleware.entangled.control.place import found
from middleware.entangled.record import MAX_TTL, Record, hashed_key


class Refusal(Exception):
    """The node rejected the request; ``str()`` is one line for display."""


class Asker:
    """A client of one node's control socket; raises ``NoControl`` if there is none on this machine."""

    def __init__(self, node: str | None, ask: Ask) -> None:
        self._path: Path = found(node)
        self._ask = ask

    def records(self, key: str, concern: str = "majority") -> list[Record]:
        """Return the records of the network under the key of a text; the ``concern`` ``fast`` uses the first reply.

        The node has verified the signatures; they are not sent over the socket.  Raises ``Refusal``.
        """
        answer = self._request("dht get", key=key, concern=concern)
        if not isinstance(answer, list):
            raise Refusal(f"the node's reply to a read of {key!r} is not a list of records; update the node")
        return [_parse_record(hashed_key(key), each) for each in answer]

    def devices(self) -> list[tuple[Device, Record]]:
        """Return the team's devices in the order of joining, each with its record; raises ``Refusal``."""
        answer = self._request("devices")
        if not isinstance(answer, list):
            raise Refusal("the node's reply about the devices is not a list of records; update the node")
        return devices_of([_parse_record(DEVICES, each) for each in answer])

    def put(self, key: str, name: str, value: bytes) -> int:
        """Store ``value`` in the node's slot; returns the number of replicas that stored it.  Raises ``Refusal``."""
        given = {"base64": base64.b64encode(value).decode()}
        return int(self._request("dht put", key=key, name=name, value=given)["replicas"])

    def call(self, address: str, method: str, *arguments: Any) -> Any:
        """Call a method of the node at ``address`` (HOST:PORT), once, and return its result; raises ``Refusal``."""
        return self._request("rpc", node=address, method=method, arguments=list(arguments), changes=True)

    def links(self) -> list[dict[str, Any]]:
        """Return the links to the node's peers, with the round-trip times of some probes; raises ``Refusal``."""
        answer = self._request("links")
        if not isinstance(answer, list):
            raise Refusal("the node's reply about its links is not a list; update the node")
        return answer

    def _request(self, verb: str, **given: Any) -> Any:
        for line in self._ask(self._path, {"verb": verb, "with": given}):
            if "error" in line:
                raise Refusal(str(line.get("text", line["error"])))
            if "answer" in line:
                return line["answer"]
        raise Refusal("the node closed the connection without a reply; check the log of the node")


def _parse_record(key: bytes, fields: dict[str, Any]) -> Record:
    value = word.value(fields["value"])
    content = value.encode() if isinstance(value, str) else bytes(value)
    owner = bytes.fromhex(fields["owner"])
    return Record(key, fields["name"], owner, fields["sequence"], fields["lifetime"], MAX_TTL, content)
