"""Verb: what the control socket can ask of a node; each takes plain JSON and answers in plain JSON."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast, get_args

from twisted.internet.defer import Deferred, maybeDeferred
from twisted.internet.interfaces import IReactorTime

from middleware.entangled.contact import Contact
from middleware.entangled.control import word
from middleware.entangled.control.health import health, links
from middleware.entangled.errors import LocalError
from middleware.entangled.network.network import Address
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import KEY_BYTES, Lifetime, Record, hashed_key
from middleware.entangled.replication.owner import Concern, Stored
from middleware.entangled.replication.reader import ReadConcern
from middleware.entangled.replication.watch import Watch
from middleware.entangled.space.keyword import Keywords, Match
from middleware.entangled.space.template import ANY, Field, where
from middleware.entangled.space.tuplespace import TupleSpace

RAW = "id:"
KINDS: Mapping[str, type] = {"int": int, "float": float, "str": str, "bytes": bytes, "bool": bool}
MAX_WAIT = 86_400.0

Tell = Callable[[Any], None]


class BadRequest(LocalError):
    """A verb or an argument that nothing can be done with."""


@dataclass(frozen=True)
class Verbs:
    """The verbs of one node; ``run`` is all that a socket needs."""

    node: EntangledNode
    space: TupleSpace
    keywords: Keywords
    clock: IReactorTime

    @classmethod
    def of(cls, node: EntangledNode, clock: IReactorTime, rng: random.Random) -> Verbs:
        """The verbs of ``node``, over the tuple space that has no other name."""
        return cls(node, TupleSpace(node, clock, rng), Keywords(node), clock)

    def run(self, name: object, arguments: object, tell: Tell) -> Deferred[Any]:
        """Do what ``name`` says; events go to ``tell``, the Deferred fires with the answer and may be cancelled.

        Every trouble is a failure of the Deferred: ``BadRequest`` for what the caller got wrong.
        """
        return maybeDeferred(self._run, name, arguments, tell)

    def _run(self, name: object, arguments: object, tell: Tell) -> object:
        verb = self._verbs().get(name) if isinstance(name, str) else None
        if verb is None:
            raise BadRequest(f"no verb {name!r}; there are {', '.join(sorted(self._verbs()))}")
        if not isinstance(arguments, dict):
            raise BadRequest("the arguments of a verb are an object with names")
        return verb(Arguments(arguments), tell)

    def _verbs(self) -> Mapping[str, Callable[[Arguments, Tell], object]]:
        return {
            "dht get": self._dht_get,
            "dht put": self._dht_put,
            "dht remove": self._dht_remove,
            "dht find": self._dht_find,
            "dht watch": self._dht_watch,
            "keyword publish": lambda a, _: self.keywords.publish(a.text("name"), a.data("value")),
            "keyword remove": lambda a, _: self.keywords.remove(a.text("name")),
            "keyword search": self._keyword_search,
            "keyword watch": self._keyword_watch,
            "tuple put": lambda a, _: self.space.put(a.fields("fields"), a.seconds("ttl")),
            "tuple get": self._tuple_get,
            "tuple read": self._tuple_read,
            "rpc": self._rpc,
            "health": lambda a, _: health(self.node),
            "links": lambda a, _: Deferred.fromCoroutine(links(self.node, self.clock)),
        }

    # -- dht --------------------------------------------------------------------------------------------------------

    def _dht_get(self, a: Arguments, tell: Tell) -> object:
        concern = cast(ReadConcern, a.choice("concern", "majority", get_args(ReadConcern)))
        return self.node.get(key_of(a.text("key")), concern).addCallback(rows_of)

    def _dht_put(self, a: Arguments, tell: Tell) -> object:
        lifetime = cast(Lifetime, a.choice("lifetime", "team", get_args(Lifetime)))
        concern = cast(Concern, a.choice("concern", "majority", get_args(Concern)))
        key, name, value = key_of(a.text("key")), a.text("name", ""), a.data("value")
        put = self.node.put(key, name, value, lifetime, concern, a.whole("expect"))
        return put.addCallback(_stored)

    def _dht_remove(self, a: Arguments, tell: Tell) -> object:
        removed = self.node.remove(key_of(a.text("key")), a.text("name", ""))
        return removed.addCallback(_stored)

    def _dht_find(self, a: Arguments, tell: Tell) -> object:
        found = self.node.find_node(key_of(a.text("key")))
        return found.addCallback(lambda contacts: [_contact(contact) for contact in contacts])

    def _dht_watch(self, a: Arguments, tell: Tell) -> object:
        return _until_cancelled(self.node.watch(key_of(a.text("key")), lambda records: tell(rows_of(records))))

    # -- keywords and tuples ----------------------------------------------------------------------------------------

    def _keyword_search(self, a: Arguments, tell: Tell) -> object:
        return self.keywords.search(a.text("words")).addCallback(_matches)

    def _keyword_watch(self, a: Arguments, tell: Tell) -> object:
        return _until_cancelled(self.keywords.watch_keyword(a.text("words"), lambda found: tell(_matches(found))))

    def _tuple_get(self, a: Arguments, tell: Tell) -> object:
        template, wait = a.template("template"), a.seconds("wait")
        found: Deferred[Any] = self.space.get(template, wait) if wait else self.space.get_if_exists(template)
        return found.addCallback(word.plain)

    def _tuple_read(self, a: Arguments, tell: Tell) -> object:
        template, wait = a.template("template"), a.seconds("wait")
        found: Deferred[Any]
        if a.flag("all"):
            found = self.space.read_all(template)
        else:
            found = self.space.read(template, wait) if wait else self.space.read_if_exists(template)
        return found.addCallback(word.plain)

    # -- rpc --------------------------------------------------------------------------------------------------------

    def _rpc(self, a: Arguments, tell: Tell) -> object:
        return Deferred.fromCoroutine(
            self._ask(a.text("node"), a.text("method"), a.fields("arguments"), a.flag("changes"))
        )

    async def _ask(self, whom: str, method: str, arguments: Sequence[Any], is_changing: bool) -> object:
        contact = await self._contact(whom)
        return word.plain(await self.node.call(contact, method, *arguments, changes=is_changing))

    async def _contact(self, whom: str) -> Contact:
        host, colon, port = whom.rpartition(":")
        if colon and port.isdecimal():
            number = int(port) if len(port) <= 5 else 0
            if not 0 < number < 65536:
                raise BadRequest(f"{whom!r:.80}: a port is 1 to 65535")
            return await self.node.endpoint.greet(Address(host.strip("[]"), number))
        known = self.node.overlay.table.contacts()
        meant = [contact for contact in known if contact.node_id.hex().startswith(whom.lower())] if whom else []
        if len(meant) == 1:
            return meant[0]
        problem = f"{len(meant)} known nodes begin with" if meant else "no known node begins with"
        raise BadRequest(f"{problem} {whom!r}; say HOST:PORT, or more of the node's id (swarm dht find)")


class Arguments:
    """The named arguments of one request, each checked when it is asked for; raises ``BadRequest``."""

    def __init__(self, given: Mapping[str, Any]) -> None:
        self._given = given

    def text(self, name: str, otherwise: str | None = None) -> str:
        """A text."""
        value = self._given.get(name, otherwise)
        if not isinstance(value, str):
            raise BadRequest(f"{name}: must be a text" if name in self._given else f"{name}: is missing")
        return value

    def choice(self, name: str, otherwise: str, choices: Sequence[str]) -> str:
        """One of ``choices``."""
        value = self.text(name, otherwise)
        if value not in choices:
            raise BadRequest(f"{name}: {value!r} is none of {', '.join(choices)}")
        return value

    def data(self, name: str) -> bytes:
        """Bytes, given as text or as ``{"base64": ...}``."""
        value = self._value(name)
        if isinstance(value, str):
            return value.encode()
        if not isinstance(value, bytes):
            raise BadRequest(f'{name}: must be a text or {{"base64": ...}}')
        return value

    def whole(self, name: str) -> int | None:
        """A whole number that is not negative, or None where it is not given."""
        value = self._given.get(name)
        if value is not None and (type(value) is not int or value < 0):
            raise BadRequest(f"{name}: must be a whole number that is not negative")
        return value

    def seconds(self, name: str) -> float | None:
        """Seconds above 0, at most a day; None where they are not given, or 0."""
        value = self._given.get(name)
        if value is None or value == 0:
            return None
        if type(value) not in (int, float) or not 0 < value <= MAX_WAIT:
            raise BadRequest(f"{name}: must be seconds, above 0 and at most {MAX_WAIT:.0f}")
        return float(value)

    def flag(self, name: str) -> bool:
        """Whether it is set."""
        return self._given.get(name) is True

    def fields(self, name: str) -> list[Any]:
        """The fields of a tuple, or the arguments of a method."""
        value = self._value(name)
        if not isinstance(value, list):
            raise BadRequest(f"{name}: must be a list")
        return value

    def template(self, name: str) -> list[Field]:
        """The fields of a template: a value, ``{"any": true}``, ``{"kind": "int"}`` or an operator with its operand."""
        given = self._given.get(name)
        if not isinstance(given, list):
            raise BadRequest(f"{name}: must be a list")
        return [_field(each) for each in given]

    def _value(self, name: str) -> Any:
        try:
            return word.value(self._given.get(name))
        except word.BadWord as error:
            raise BadRequest(f"{name}: {error}") from error


def key_of(text: str) -> bytes:
    """The key that ``text`` means: the hash of it, or after ``id:`` the 40 hexadecimal digits of the key itself."""
    if not text.startswith(RAW):
        return hashed_key(text)
    try:
        key = bytes.fromhex(text.removeprefix(RAW))
    except ValueError:
        key = b""
    if len(key) != KEY_BYTES:
        raise BadRequest(f"key: after {RAW} come {2 * KEY_BYTES} hexadecimal digits")
    return key


def _field(given: Any) -> Field:
    try:
        if isinstance(given, dict) and "base64" not in given:
            if given.get("any") is True:
                return ANY
            if given.get("kind") in KINDS:
                return KINDS[given["kind"]]
            if "operator" in given:
                return where(given["operator"], word.value(given.get("operand")))
            raise BadRequest(f"template: no field can be read from {given!r:.80}")
        return word.value(given)  # type: ignore[no-any-return]
    except (word.BadWord, TypeError) as error:
        raise BadRequest(f"template: {error}") from error


def _stored(stored: Stored) -> dict[str, int]:
    return {"replicas": int(stored), "sequence": stored.sequence}


def rows_of(records: Sequence[Record]) -> list[dict[str, Any]]:
    """Records as the socket tells them; tombstones are left out."""
    return [
        {
            "owner": record.owner.hex(),
            "name": record.name,
            "sequence": record.sequence,
            "lifetime": record.lifetime,
            "value": word.text_or_base64(record.value),
        }
        for record in records
        if record.value is not None
    ]


def _matches(found: Sequence[Match]) -> list[dict[str, Any]]:
    return [{"name": m.name, "owner": m.owner.hex(), "value": word.text_or_base64(m.data)} for m in found]


def _contact(contact: Contact) -> dict[str, Any]:
    return {"id": contact.node_id.hex(), "host": contact.address.host, "port": contact.address.port}


def _until_cancelled(watch: Watch) -> Deferred[Any]:
    return Deferred(lambda _: watch.stop())
