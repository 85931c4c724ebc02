"""Access of a command to the network, through the control socket of a node on this machine."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

from middleware.directory.presence import DEVICES, Device, parse_devices
from middleware.entangled.control import conversion
from middleware.entangled.control.command import SendRequest
from middleware.entangled.control.socket_path import find_socket
from middleware.entangled.record import MAX_TTL_S, Record, hash_key


class Rejection(Exception):
    """The node rejected the request; ``str()`` is one line for display."""


class ControlClient:
    """A client of one node's control socket; raises ``NoControl`` if no such node runs on this machine."""

    def __init__(self, node: str | None, ask: SendRequest) -> None:
        self._path: Path = find_socket(node)
        self._ask = ask

    def get_records(self, key: str, concern: str = "majority") -> list[Record]:
        """Return the network's records under the hash of the text ``key``.

        The ``concern`` ``fast`` uses the first reply; ``majority`` waits for a majority of the replicas.  The node has
        verified the signatures; they are not sent over the socket.  Raises ``Rejection``.
        """
        answer = self._request("dht get", key=key, concern=concern)
        if not isinstance(answer, list):
            raise Rejection(f"the node's reply to a read of {key!r} is not a list of records; update the node")
        return [_parse_record(hash_key(key), each) for each in answer]

    def list_devices(self) -> list[tuple[Device, Record]]:
        """Return the team's devices in the order of joining, each with its record; raises ``Rejection``."""
        answer = self._request("devices")
        if not isinstance(answer, list):
            raise Rejection("the node's reply about the devices is not a list of records; update the node")
        return parse_devices([_parse_record(DEVICES, each) for each in answer])

    def put(self, key: str, name: str, value: bytes) -> int:
        """Store ``value`` in the node's slot ``name``; return the number of its replicas.  Raises ``Rejection``."""
        given = {"base64": base64.b64encode(value).decode()}
        return int(self._request("dht put", key=key, name=name, value=given)["replicas"])

    def call(self, address: str, method: str, *arguments: Any) -> Any:
        """Call a method of the node at ``address`` (HOST:PORT), once, and return its result; raises ``Rejection``."""
        return self._request("rpc", node=address, method=method, arguments=list(arguments), changes=True)

    def list_links(self) -> list[dict[str, Any]]:
        """Return the links to the node's peers, with the round-trip times of recent probes; raises ``Rejection``."""
        answer = self._request("links")
        if not isinstance(answer, list):
            raise Rejection("the node's reply about its links is not a list; update the node")
        return answer

    def _request(self, verb: str, **given: Any) -> Any:
        for line in self._ask(self._path, {"verb": verb, "with": given}):
            if "error" in line:
                raise Rejection(str(line.get("text", line["error"])))
            if "answer" in line:
                return line["answer"]
        raise Rejection("the node closed the connection without a reply; check the log of the node")


def _parse_record(key: bytes, fields: dict[str, Any]) -> Record:
    value = conversion.from_json(fields["value"])
    content = value.encode() if isinstance(value, str) else bytes(value)
    owner = bytes.fromhex(fields["owner"])
    return Record(key, fields["name"], owner, fields["sequence"], fields["lifetime"], MAX_TTL_S, content)
