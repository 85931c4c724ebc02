"""Asker: what a command reads and writes of the network, through the control socket of a node of this machine."""

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
    """The node, or what it knows, says no; ``str()`` is one line for a person."""


class Asker:
    """One node of this machine, asked through its control socket; raises ``NoControl`` where there is none."""

    def __init__(self, node: str | None, ask: Ask) -> None:
        self._path: Path = found(node)
        self._ask = ask

    def records(self, key: str, concern: str = "majority") -> list[Record]:
        """What the network holds under the key of a text; the ``concern`` ``fast`` takes the first answer.

        The node has checked the signatures; they do not come through the socket.  Raises ``Refusal``.
        """
        answer = self._answer("dht get", key=key, concern=concern)
        if not isinstance(answer, list):
            raise Refusal(f"the node's answer to a read of {key!r} is no list of records")
        return [_record(hashed_key(key), each) for each in answer]

    def devices(self) -> list[tuple[Device, Record]]:
        """All devices of the team in the order of joining, each with its record.  Raises ``Refusal``."""
        answer = self._answer("devices")
        if not isinstance(answer, list):
            raise Refusal("the node's answer about the devices is no list of records")
        return devices_of([_record(DEVICES, each) for each in answer])

    def put(self, key: str, name: str, value: bytes) -> int:
        """Store ``value`` in the node's own slot; returns how many replicas have it.  Raises ``Refusal``."""
        given = {"base64": base64.b64encode(value).decode()}
        return int(self._answer("dht put", key=key, name=name, value=given)["replicas"])

    def call(self, address: str, method: str, *arguments: Any) -> Any:
        """Let the node at ``address`` (HOST:PORT) do something, once; returns its answer.  Raises ``Refusal``."""
        return self._answer("rpc", node=address, method=method, arguments=list(arguments), changes=True)

    def links(self) -> list[dict[str, Any]]:
        """The ways to the node's peers, with the times of some questions to each.  Raises ``Refusal``."""
        answer = self._answer("links")
        if not isinstance(answer, list):
            raise Refusal("the node's answer about its links is no list")
        return answer

    def _answer(self, verb: str, **given: Any) -> Any:
        for line in self._ask(self._path, {"verb": verb, "with": given}):
            if "error" in line:
                raise Refusal(str(line.get("text", line["error"])))
            if "answer" in line:
                return line["answer"]
        raise Refusal("the node closed the connection without an answer")


def _record(key: bytes, told: dict[str, Any]) -> Record:
    value = word.value(told["value"])
    content = value.encode() if isinstance(value, str) else bytes(value)
    owner = bytes.fromhex(told["owner"])
    return Record(key, told["name"], owner, told["sequence"], told["lifetime"], MAX_TTL, content)
