"""The board: all that the answers of the page's routes may use, each part behind a protocol.

Whoever needs a part asks for it here, so that no route knows how it is done.  The parts that every web node has come
with a twin in memory; what is None the node does not have, and the page, told by ``has``, shows nothing of it.
Everything is called on the reactor's thread.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

from twisted.internet.defer import Deferred, succeed

from webnode.desk import Desk
from webnode.field import Json
from webnode.state import State

Role = Literal["anyone", "viewer", "operator", "phone"]
AUDITED = 200


@dataclass(frozen=True)
class Visitor:
    """Who asks; ``token_id`` names what it signed in with, and is no secret.

    It is let in ``until`` then (unix seconds), which it may have put off, no further than to ``limit``, unless it shows
    a ticket.  It ends with the sessions ``parents``, too; ``vouchers`` are the keys of the web nodes that vouch for it.
    """

    name: str = ""
    role: Role = "anyone"
    token_id: str = ""
    until: float = math.inf
    limit: float = math.inf
    is_ticket: bool = False
    parents: tuple[str, ...] = ()
    vouchers: tuple[bytes, ...] = ()


@dataclass(frozen=True)
class Token:
    """What a visitor who signed in shows: ``text`` in a header, ``ticket`` in the query of a GET.

    The ticket stands for the same session and lets look only, as a URL is seen by more than a header.  ``until`` is
    unix seconds.
    """

    text: str
    ticket: str
    role: Role
    until: float


class Sessions(Protocol):
    """Who has signed in; ``now`` is unix seconds."""

    code: str
    """What operators sign in with; empty where nobody needs to."""

    def sign_in(self, proof: str, source: str, now: float) -> Deferred[Token]:
        """Sign in with a code or password, from the address ``source``; fails with ``Refusal`` 401 or 429."""

    def visitor(self, token: str, now: float) -> Visitor:
        """Who shows this token or ticket; never raises, and changes nothing.  Without one: anyone."""

    def token(self, who: Visitor, name: str, role: Role, now: float, seconds: float) -> Token:
        """A token for somebody whom ``who`` brings in, for no longer than ``who`` can stay."""

    def derived(self, who: Visitor, name: str, role: Role, now: float, seconds: float) -> Token:
        """A token for ``who`` under another name, which ends with the session."""

    def renewed(self, who: Visitor, now: float) -> Token:
        """Another token for the same session, good for longer; raises ``Refusal`` 401 for anyone and for a ticket."""

    def passes(self, who: Visitor, nodes: Iterable[str], now: float) -> dict[str, Token]:
        """Tokens for the same session at the web nodes with the uuids ``nodes``, each good there alone, for minutes.

        Raises ``Refusal`` 401 for anyone and for a ticket.
        """

    def revoke(self, token_id: str, until: float = math.inf) -> None:
        """Let in nobody with this token any more, nor with one that was made of it; it runs out ``until`` then."""


class OpenSessions:
    """Everybody is an operator while ``may_serve``: for a page of this machine alone, and for tests."""

    code = ""

    def __init__(self, may_serve: Callable[[], bool] = lambda: True) -> None:
        self._may_serve = may_serve

    def sign_in(self, proof: str, source: str, now: float) -> Deferred[Token]:
        """Let in whoever asks, for a day."""
        return succeed(self.token(Visitor(), "visitor", "operator", now, 86400.0))

    def visitor(self, token: str, now: float) -> Visitor:
        """Return an operator."""
        return Visitor("visitor", "operator") if self._may_serve() else Visitor()

    def token(self, who: Visitor, name: str, role: Role, now: float, seconds: float) -> Token:
        """Return one that says nothing."""
        return Token("open", "open", role, now + seconds)

    derived = token

    def renewed(self, who: Visitor, now: float) -> Token:
        """Return one that says nothing."""
        return self.token(who, who.name, who.role, now, 86400.0)

    def passes(self, who: Visitor, nodes: Iterable[str], now: float) -> dict[str, Token]:
        """Return one that says nothing for each."""
        return {node: self.renewed(who, now) for node in nodes}

    def revoke(self, token_id: str, until: float = math.inf) -> None:
        """Do nothing."""


class Audit(Protocol):
    """Who changed what."""

    def note(self, who: Visitor, source: str, route: str, target: str, outcome: str) -> None:
        """Keep one line: ``route`` is method and path, ``target`` what its path named, ``outcome`` the status."""

    def newest(self, count: int) -> list[dict[str, Json]]:
        """The newest lines, the newest first; at most ``AUDITED``."""

    def counts(self) -> Mapping[tuple[str, str], int]:
        """How many there were since the start, by role and status."""


class MemoryAudit:
    """The newest lines, forgotten when the node ends; ``wall`` is unix time in seconds."""

    def __init__(self, wall: Callable[[], float] = lambda: 0.0) -> None:
        self._wall = wall
        self._lines: deque[dict[str, Json]] = deque(maxlen=AUDITED)
        self._counts: Counter[tuple[str, str]] = Counter()

    def note(self, who: Visitor, source: str, route: str, target: str, outcome: str) -> None:
        """Keep one line."""
        self._counts[who.role, outcome[:3]] += 1
        line: dict[str, Json] = {"at": round(self._wall(), 3), "who": who.name, "role": who.role, "from": source}
        self._lines.appendleft({**line, "session": who.token_id, "route": route, "target": target, "outcome": outcome})

    def newest(self, count: int) -> list[dict[str, Json]]:
        """The newest lines, the newest first."""
        return list(self._lines)[:count]

    def counts(self) -> Mapping[tuple[str, str], int]:
        """How many there were."""
        return self._counts


@dataclass(frozen=True)
class Entry:
    """Something that happened: ``n`` counts them, ``at`` is unix seconds, ``seconds`` how long it took (or None)."""

    n: int
    at: float
    kind: str
    uuid: str
    task: str
    text: str
    seconds: float | None = None


class Chronicle(Protocol):
    """What happened in the team since this node looks."""

    def saw(self, state: State, now: float) -> None:
        """Take the next state."""

    def faulted(self, uuid: str, kind: str, now: float) -> None:
        """Remember that a fault was caused on purpose, so that the takeover is timed from it."""

    def since(self, number: int, about: str = "") -> list[Entry]:
        """The entries after ``number``, those about one device or task where ``about`` names it."""


class MemoryChronicle:
    """Entries put there by hand, in ``entries``; ``faults`` are (uuid, kind, now)."""

    def __init__(self) -> None:
        self.entries: list[Entry] = []
        self.faults: list[tuple[str, str, float]] = []

    def saw(self, state: State, now: float) -> None:
        """Make nothing of it."""

    def faulted(self, uuid: str, kind: str, now: float) -> None:
        """Write it down."""
        self.faults.append((uuid, kind, now))

    def since(self, number: int, about: str = "") -> list[Entry]:
        """The entries after ``number``."""
        return [entry for entry in self.entries if entry.n > number and about in ("", entry.uuid, entry.task)]


@dataclass(frozen=True)
class Page:
    """A URL at which a node of the team serves the page; ``node`` is the node's uuid."""

    node: str
    url: str
    is_secure: bool = False
    is_self: bool = False


class Fallbacks(Protocol):
    """The web nodes of the team."""

    def here(self) -> list[Page]:
        """Where the page is served now."""

    def serves(self, urls: Iterable[str]) -> None:
        """Tell the team that this node serves the page at ``urls``, too."""

    def lets_in(self, origin: str) -> bool:
        """Whether a page that came from ``origin`` may ask here: it is, or was a short while ago, one of the team's."""


class MemoryFallbacks:
    """The pages that it was made with, and no others."""

    def __init__(self, *pages: Page) -> None:
        self.pages = list(pages)

    def here(self) -> list[Page]:
        """Return them."""
        return self.pages

    def serves(self, urls: Iterable[str]) -> None:
        """Add them as pages of ``here``."""
        self.pages += [Page("here", url, url.startswith("https:"), True) for url in urls]

    def lets_in(self, origin: str) -> bool:
        """Whether one of them is served there."""
        return origin in [page.url for page in self.pages]


Kept = Literal["unfinished", "stream", "open"]
"""Requests that are not complete, answers that are under way, connections."""


class Limits(Protocol):
    """How much one address may have open at once; whoever opens something counts it, and again when it ends."""

    def may(self, kind: Kept, address: str) -> bool:
        """Whether it may have one more."""

    def count(self, kind: Kept, address: str, by: int) -> None:
        """Count one more (1), or one less (-1)."""

    def total(self, kind: Kept) -> int:
        """How many there are of all addresses."""


class NoLimits:
    """As much as it likes."""

    def may(self, kind: Kept, address: str) -> bool:
        """Return True."""
        return True

    def count(self, kind: Kept, address: str, by: int) -> None:
        """Count nothing."""

    def total(self, kind: Kept) -> int:
        """Return 0."""
        return 0


class Survey(Protocol):
    """What devices answer when they are asked over the network; Deferreds fail with ``Refusal`` 409 or 504."""

    def network(self) -> Deferred[Json]:
        """Who knows whom, and how far they are."""

    def links(self) -> Deferred[Json]:
        """By which way each reaches the others, how well, and whom it met that was not let in."""

    def team(self) -> Json:
        """What team this is, and who is in it."""

    def inventory(self, uuid: str) -> Deferred[Json]:
        """What a device stores."""


class Halts(Protocol):
    """Stopping the whole team; answers map each uuid to ``stands``, or to why it does not."""

    def halt(self, by: str) -> Deferred[dict[str, str]]:
        """Let everything stand, and stay."""

    def release(self, by: str, stops: Sequence[str] | None = None) -> Deferred[dict[str, str]]:
        """End these stops, ids in hex, and no other ones; all that are known where none are named."""


class Faults(Protocol):
    """Faults that are caused on purpose, where devices allow it; each heals itself after its seconds."""

    def kinds(self, uuid: str) -> Sequence[str]:
        """What can be caused there."""

    def cause(self, uuid: str, kind: str, seconds: float, amount: float | None) -> Deferred[None]:
        """Cause one, without an ``amount`` as much as is usual; fires when the device has said that it will.

        Fails with ``Refusal``: 400 names the field, 409 and 504 the device.
        """

    def active(self) -> list[dict[str, Json]]:
        """Those that go on or ended a short while ago, the newest first, and what came of each.

        ``n`` counts them; ``left_s`` and ``since_s`` are its seconds to come and gone; ``task`` is what the device was
        at; ``takeover_s`` and ``to`` are the seconds until another (by name) acted on that task, None and empty until
        then; ``watched`` says whether the clock runs.
        """


@dataclass(frozen=True)
class Wanted:
    """What a phone is asked for: so many pictures a second, and words for who holds it."""

    fps: float
    say: str = ""


class Phones(Protocol):
    """Phones that take part as devices, with this node as their way into the team."""

    def join(self, secret: bytes, name: str, can: Mapping[str, Any]) -> Deferred[str]:
        """Let a phone take part; fires with its uuid, which is the same for the same secret at every web node.

        ``can`` is what it has: ``width`` and ``height`` of its pictures in pixels, and whether it tells ``orientation``
        and ``position``.  Fails with ``Refusal`` 409 or 429 where it may not, 503 where that cannot be.
        """

    def look(self, uuid: str, jpeg: bytes, values: Mapping[str, float]) -> Wanted:
        """Take what it sees and measures.

        Raises ``Refusal`` 400 where it is no picture that is used, 404 where the phone takes no part here, 429 where it
        looks too often.
        """

    def leave(self, uuid: str) -> None:
        """Let it go; one that is not here has gone already."""

    def close(self) -> Deferred[Any]:
        """Let all of them go; fires when they have."""


class Invites(Protocol):
    """What somebody else needs to come to the page."""

    authority: bytes
    """The certificate of the authority that a browser has to trust, as PEM; empty where there is no TLS."""
    fingerprint: str
    """What a person compares it by."""

    def urls(self) -> list[str]:
        """Where this node serves the page, the best for others first."""

    def drawn(self, text: str) -> Deferred[str]:
        """A QR code of ``text`` as an SVG; empty where none can be drawn."""


@dataclass
class Board:
    """All of it; who may come in is always said, the rest is the twin in memory, or None for what a node may lack."""

    desk: Desk
    sessions: Sessions
    audit: Audit = field(default_factory=MemoryAudit)
    chronicle: Chronicle = field(default_factory=MemoryChronicle)
    fallbacks: Fallbacks = field(default_factory=MemoryFallbacks)
    limits: Limits = field(default_factory=NoLimits)
    survey: Survey | None = None
    halts: Halts | None = None
    faults: Faults | None = None
    phones: Phones | None = None
    invites: Invites | None = None

    @property
    def has(self) -> list[str]:
        """What this node has beyond what every web node has, for the page."""
        parts = ("survey", "halts", "faults", "phones", "invites")
        yard = ["yard"] if self.desk.yard() is not None else []
        return yard + [name for name in parts if getattr(self, name) is not None]
