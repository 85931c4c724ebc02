"""The verbs of the control socket, with JSON arguments and answers."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast, get_args

from twisted.internet.defer import Deferred, maybeDeferred
from twisted.internet.interfaces import IReactorTime

from middleware.entangled.contact import Contact
from middleware.entangled.control import conversion
from middleware.entangled.control.health import measure_links, read_health
from middleware.entangled.errors import LocalError
from middleware.entangled.network.network import Address
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import KEY_BYTES, Lifetime, Record, hash_key
from middleware.entangled.replication.owner import ConsistencyLevel, Stored
from middleware.entangled.replication.reader import ReadConsistency
from middleware.entangled.replication.watch import Watch
from middleware.entangled.space.keyword import Keywords, Match
from middleware.entangled.space.template import ANY, Field, where
from middleware.entangled.space.tuplespace import TupleSpace

RAW_PREFIX = "id:"
KINDS: Mapping[str, type] = {"int": int, "float": float, "str": str, "bytes": bytes, "bool": bool}
MAX_WAIT_S = 86_400.0

SendEvent = Callable[[Any], None]


class BadRequest(LocalError):
    """The verb or an argument is invalid."""


@dataclass(frozen=True)
class RequestHandler:
    """The verbs of one node; the socket calls ``run``."""

    node: EntangledNode
    space: TupleSpace
    keywords: Keywords
    clock: IReactorTime

    @classmethod
    def create(cls, node: EntangledNode, clock: IReactorTime, rng: random.Random) -> RequestHandler:
        """Return the verbs of ``node``, with the default tuple space."""
        return cls(node, TupleSpace(node, clock, rng), Keywords(node), clock)

    def run(self, name: object, args: object, send_event: SendEvent) -> Deferred[Any]:
        """Run the verb ``name``; call ``send_event`` with each event; the Deferred fires with the answer.

        The Deferred can be cancelled.  It fails with the error of the verb, or with ``BadRequest`` for an invalid verb
        or argument.
        """
        return maybeDeferred(self._run, name, args, send_event)

    def _run(self, name: object, args: object, send_event: SendEvent) -> object:
        verb = self._find_handlers().get(name) if isinstance(name, str) else None
        if verb is None:
            raise BadRequest(f"there is no verb {name!r}; the verbs are {', '.join(sorted(self._find_handlers()))}")
        if not isinstance(args, dict):
            raise BadRequest("the arguments of a verb must be a JSON object")
        return verb(Arguments(args), send_event)

    def _find_handlers(self) -> Mapping[str, Callable[[Arguments, SendEvent], object]]:
        return {
            "dht get": self._dht_get,
            "dht put": self._dht_put,
            "dht remove": self._dht_remove,
            "dht find": self._dht_find,
            "dht watch": self._dht_watch,
            "keyword publish": lambda args, _: self.keywords.publish(args.text("name"), args.data("value")),
            "keyword remove": lambda args, _: self.keywords.remove(args.text("name")),
            "keyword search": self._keyword_search,
            "keyword watch": self._keyword_watch,
            "tuple put": lambda args, _: self.space.put(args.fields("fields"), args.seconds("ttl")),
            "tuple get": self._tuple_get,
            "tuple read": self._tuple_read,
            "rpc": self._rpc,
            "health": lambda args, _: read_health(self.node),
            "links": lambda args, _: Deferred.fromCoroutine(measure_links(self.node, self.clock)),
        }

    # -- dht --------------------------------------------------------------------------------------------------------

    def _dht_get(self, args: Arguments, send_event: SendEvent) -> object:
        concern = cast(ReadConsistency, args.choice("concern", "majority", get_args(ReadConsistency)))
        return self.node.get(parse_key(args.text("key")), concern).addCallback(make_rows)

    def _dht_put(self, args: Arguments, send_event: SendEvent) -> object:
        lifetime = cast(Lifetime, args.choice("lifetime", "team", get_args(Lifetime)))
        concern = cast(ConsistencyLevel, args.choice("concern", "majority", get_args(ConsistencyLevel)))
        key, name, value = parse_key(args.text("key")), args.text("name", ""), args.data("value")
        put = self.node.put(key, name, value, lifetime, concern, args.integer("expect"))
        return put.addCallback(_make_stored)

    def _dht_remove(self, args: Arguments, send_event: SendEvent) -> object:
        removed = self.node.remove(parse_key(args.text("key")), args.text("name", ""))
        return removed.addCallback(_make_stored)

    def _dht_find(self, args: Arguments, send_event: SendEvent) -> object:
        found = self.node.find_node(parse_key(args.text("key")))
        return found.addCallback(lambda contacts: [_make_contact(contact) for contact in contacts])

    def _dht_watch(self, args: Arguments, send_event: SendEvent) -> object:
        return _until_cancelled(
            self.node.watch(parse_key(args.text("key")), lambda records: send_event(make_rows(records)))
        )

    # -- keywords and tuples ----------------------------------------------------------------------------------------

    def _keyword_search(self, args: Arguments, send_event: SendEvent) -> object:
        return self.keywords.search(args.text("words")).addCallback(_make_matches)

    def _keyword_watch(self, args: Arguments, send_event: SendEvent) -> object:
        return _until_cancelled(
            self.keywords.watch_keyword(args.text("words"), lambda found: send_event(_make_matches(found)))
        )

    def _tuple_get(self, args: Arguments, send_event: SendEvent) -> object:
        template, wait = args.template("template"), args.seconds("wait")
        found: Deferred[Any] = self.space.get(template, wait) if wait else self.space.get_if_exists(template)
        return found.addCallback(conversion.to_json)

    def _tuple_read(self, args: Arguments, send_event: SendEvent) -> object:
        template, wait = args.template("template"), args.seconds("wait")
        found: Deferred[Any]
        if args.flag("all"):
            found = self.space.read_all(template)
        else:
            found = self.space.read(template, wait) if wait else self.space.read_if_exists(template)
        return found.addCallback(conversion.to_json)

    # -- rpc --------------------------------------------------------------------------------------------------------

    def _rpc(self, args: Arguments, send_event: SendEvent) -> object:
        return Deferred.fromCoroutine(
            self._ask(
                args.text("node"),
                args.text("method"),
                args.fields("arguments"),
                args.flag("changes"),
            )
        )

    async def _ask(self, target: str, method: str, args: Sequence[Any], is_changing: bool) -> object:
        contact = await self._find_contact(target)
        return conversion.to_json(await self.node.call(contact, method, *args, changes=is_changing))

    async def _find_contact(self, target: str) -> Contact:
        host, colon, port = target.rpartition(":")
        if colon and port.isdecimal():
            number = int(port) if len(port) <= 5 else 0
            if not 0 < number < 65536:
                raise BadRequest(f"{target!r:.80}: the port must be from 1 to 65535")
            return await self.node.endpoint.discover(Address(host.strip("[]"), number))
        known = self.node.overlay.table.list_contacts()
        matching = [contact for contact in known if contact.node_id.hex().startswith(target.lower())] if target else []
        if len(matching) == 1:
            return matching[0]
        problem = f"{len(matching)} known nodes begin with" if matching else "no known node begins with"
        raise BadRequest(f"{problem} {target!r}; use HOST:PORT, or more digits of the node's id (swarm dht find)")


class Arguments:
    """The named arguments of one request; each method checks one argument and raises ``BadRequest``."""

    def __init__(self, given: Mapping[str, Any]) -> None:
        self._given = given

    def text(self, name: str, default: str | None = None) -> str:
        """Return a string argument."""
        value = self._given.get(name, default)
        if not isinstance(value, str):
            raise BadRequest(f"{name} must be a string" if name in self._given else f"{name} is missing")
        return value

    def choice(self, name: str, default: str, choices: Sequence[str]) -> str:
        """Return one of ``choices``."""
        value = self.text(name, default)
        if value not in choices:
            raise BadRequest(f"{name} must be one of {', '.join(choices)}, not {value!r}")
        return value

    def data(self, name: str) -> bytes:
        """Return bytes, given as a string or as ``{"base64": ...}``."""
        value = self._value(name)
        if isinstance(value, str):
            return value.encode()
        if not isinstance(value, bytes):
            raise BadRequest(f'{name} must be a string or {{"base64": ...}}')
        return value

    def integer(self, name: str) -> int | None:
        """Return a non-negative integer, or None if absent."""
        value = self._given.get(name)
        if value is not None and (type(value) is not int or value < 0):
            raise BadRequest(f"{name} must be a non-negative integer")
        return value

    def seconds(self, name: str) -> float | None:
        """Return seconds, at most a day; None if absent or 0."""
        value = self._given.get(name)
        if value is None or value == 0:
            return None
        if type(value) not in (int, float) or not 0 < value <= MAX_WAIT_S:
            raise BadRequest(f"{name} must be a number of seconds above 0 and at most {MAX_WAIT_S:.0f}")
        return float(value)

    def flag(self, name: str) -> bool:
        """Return whether the argument is true."""
        return self._given.get(name) is True

    def fields(self, name: str) -> list[Any]:
        """Return the fields of a tuple, or the arguments of a method."""
        value = self._value(name)
        if not isinstance(value, list):
            raise BadRequest(f"{name}: must be a list")
        return value

    def template(self, name: str) -> list[Field]:
        """Return template fields: a value, ``{"any": true}``, ``{"kind": "int"}`` or an operator with its operand."""
        given = self._given.get(name)
        if not isinstance(given, list):
            raise BadRequest(f"{name}: must be a list")
        return [_parse_field(each) for each in given]

    def _value(self, name: str) -> Any:
        try:
            return conversion.from_json(self._given.get(name))
        except conversion.InvalidValue as error:
            raise BadRequest(f"{name}: {error}") from error


def parse_key(text: str) -> bytes:
    """Return the hash of ``text``, or the key itself if ``text`` is ``id:`` and 40 hexadecimal digits."""
    if not text.startswith(RAW_PREFIX):
        return hash_key(text)
    try:
        key = bytes.fromhex(text.removeprefix(RAW_PREFIX))
    except ValueError:
        key = b""
    if len(key) != KEY_BYTES:
        raise BadRequest(f"key: {RAW_PREFIX} must be followed by {2 * KEY_BYTES} hexadecimal digits")
    return key


def _parse_field(given: Any) -> Field:
    try:
        if isinstance(given, dict) and "base64" not in given:
            if given.get("any") is True:
                return ANY
            if given.get("kind") in KINDS:
                return KINDS[given["kind"]]
            if "operator" in given:
                return where(given["operator"], conversion.from_json(given.get("operand")))
            raise BadRequest(f"template: {given!r:.80} is not a template field")
        return conversion.from_json(given)  # type: ignore[no-any-return]
    except (conversion.InvalidValue, TypeError) as error:
        raise BadRequest(f"template: {error}") from error


def _make_stored(stored: Stored) -> dict[str, int]:
    return {"replicas": int(stored), "sequence": stored.sequence}


def make_rows(records: Sequence[Record]) -> list[dict[str, Any]]:
    """Return records in the form of the socket's answers, without tombstones."""
    return [
        {
            "owner": record.owner.hex(),
            "name": record.name,
            "sequence": record.sequence,
            "lifetime": record.lifetime,
            "value": conversion.text_or_base64(record.value),
        }
        for record in records
        if record.value is not None
    ]


def _make_matches(found: Sequence[Match]) -> list[dict[str, Any]]:
    return [{"name": m.name, "owner": m.owner.hex(), "value": conversion.text_or_base64(m.data)} for m in found]


def _make_contact(contact: Contact) -> dict[str, Any]:
    return {"id": contact.node_id.hex(), "host": contact.address.host, "port": contact.address.port}


def _until_cancelled(watch: Watch) -> Deferred[Any]:
    return Deferred(lambda _: watch.stop())
