"""Endpoint: a node's end of the wire; asks, answers and tells in sealed datagrams.

It sorts what arrives, keeps the table of sessions, and drops and counts what does not open.  How questions are repeated
stands in ``asker``, how they are answered in ``answerer``; ``docs/reference/wire-protocol.md`` has every byte.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

from twisted.internet import defer
from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from middleware.entangled.bounded import keep
from middleware.entangled.contact import Contact
from middleware.entangled.errors import Forged, Malformed, NotAdmitted, NotRunning
from middleware.entangled.identity import Identity
from middleware.entangled.listeners import Listeners
from middleware.entangled.network.network import MAX_CARRIED, MAX_DATAGRAM, Address, Network
from middleware.entangled.wire.answerer import Answerer
from middleware.entangled.wire.asker import PATIENCE, Asker
from middleware.entangled.wire.courier import Courier
from middleware.entangled.wire.door import (
    DOUBLED,
    FOREIGN,
    OPEN,
    REVOKED,
    ROLE,
    SUPERSEDED,
    Door,
    Life,
    Lives,
    Noted,
    Stamps,
    checked_secrets,
    is_refusal,
    meaning,
)
from middleware.entangled.wire.greeting import COOKIE, HERE, WHO, Cookies, Greeter
from middleware.entangled.wire.hail import ECHO, HAIL, Echo, Echoer, Hailer
from middleware.entangled.wire.message import (
    PART,
    RECEIPT,
    REFUSAL,
    Answer,
    Cancel,
    Failure,
    Key,
    Question,
    Told,
    decoded,
)
from middleware.entangled.wire.method import Method
from middleware.entangled.wire.peer import Peers
from middleware.entangled.wire.rebuff import Rebuffs, Side
from middleware.entangled.wire.session import (
    DATA,
    INIT,
    INIT_LEAST,
    OVERHEAD,
    RESP,
    RESP_LEAST,
    Acceptance,
    Credentials,
    HalfOpen,
    Session,
    index_of,
    is_init_of_team,
)

_REFUSAL = bytes([REFUSAL])
MAX_REFUSALS = 32

Inside = Callable[[Session, bytes, Address], None]
"""Takes what a DATA datagram brought: its session, the plaintext, and the address that it came from."""


class Endpoint:
    """The wire of one node.

    ``team_key`` (32 bytes) is the secret of the team: who lacks it can neither read nor be answered.  ``rng`` makes the
    ephemeral keys, so outside of simulations it must be ``random.SystemRandom``, and in them no node may be given dice
    that fall as those of its former life did.  ``door`` says who is let in, and what a peer may call.

    ``on_contact`` is called when a peer has proved its key and its address: it answered us, or confirmed the session
    that it opened; ``on_seen`` with a peer and the address from which it sees us; ``on_refused`` when a peer said that
    it does not let us in, and ``on_refusing`` when we surely do not let it in, each with the name of the refusal;
    ``on_let_go`` with the key of a peer of which nothing is remembered any more, since it was silent for long.

    ``counters`` counts every datagram that was dropped, by its reason: oversized, unknown, malformed, forged, replayed,
    stale (no such session), repeated, misdirected, unasked, late, cancelled, abandoned (a parcel that stopped
    half-way); what was put off or refused for want of room (crowded, busy); and who or what was not let in (refused).
    """

    _log = Logger()

    def __init__(
        self,
        identity: Identity,
        team_key: bytes,
        network: Network,
        clock: IReactorTime,
        rng: random.Random,
        door: Door = OPEN,
    ) -> None:
        self.door = door
        self.on_contact = Listeners[[Contact]]()
        self.on_seen = Listeners[[Contact, Address]]()
        self.on_refused = Listeners[[Contact, str]]()
        self.on_refusing = Listeners[[Contact, str]]()
        self.on_let_go = Listeners[[bytes]]()
        self.refusals: dict[bytes, tuple[Contact, str]] = {}
        """By key, the peers that said that they do not let this node in, and the name of the refusal; the last few."""
        self.rebuffs = Rebuffs()
        """Refusals of the last hour, on both sides."""
        self.counters: Counter[str] = Counter()
        self.is_running = False
        self._network = network
        self._clock = clock
        self._rng = rng
        self._identity = identity
        self._own = Credentials.of(identity, team_key)
        self._lives = Lives()
        self._stamps = Stamps()
        self._noted = Noted()
        self._peers = Peers([self._own], clock, rng, network, self.counters, door)
        self._courier = Courier(
            clock,
            self._send_to,
            self._on_parcel,
            self._peers.wait_for,
            lambda number, public: self._asker.is_asked(number, public),
            lambda number, public: self._asker.progressed(number, public),
            self.counters,
        )
        self._answerer = Answerer(clock, self._send, self._courier, self.counters, door.may, self._may_not)
        self._asker = Asker(clock, rng, self._peers, self._courier, self._send, self.counters)
        self.greeter = Greeter(identity.public, self._peers, network, clock, rng, self.counters)
        self._cookies = Cookies(self._own.cookie_key, rng)
        self.echoer = Echoer(self.post, clock, lambda: door.fingerprint)
        self.hailer = Hailer(self.post, clock, rng)
        self._sessions = self._peers.sessions
        self._half_open = HalfOpen(self._sessions)
        self._inside: dict[int, Inside] = {}
        self._receivers: dict[int, Callable[[bytes, Address], None]] = {
            DATA: self._on_data,
            INIT: self._on_init,
            RESP: self._on_resp,
            WHO: self.greeter.on_who,
            HERE: self.greeter.on_here,
            COOKIE: self.greeter.on_cookie,
            HAIL: lambda datagram, source: self._count(self.echoer.on_hail(datagram, source)),
            ECHO: lambda datagram, source: self._count(self.hailer.on_echo(datagram, source)),
        }

    @property
    def address(self) -> Address:
        """The address of the network underneath."""
        return self._network.address

    def start(self) -> None:
        """Open the network; raises ``PortInUse``."""
        if not self.is_running:
            self._network.listen(self._received)
            self.is_running = True

    def stop(self) -> None:
        """Close the network, forget every session, cancel every timer; what is pending fails with ``NotRunning``."""
        if not self.is_running:
            return
        self.is_running = False
        self._network.close()
        self._answerer.clear()
        self._half_open.clear()
        error = NotRunning("the endpoint was stopped")
        self.greeter.stop(error)
        self.hailer.stop(error)
        self._asker.stop(error)
        self._courier.stop()
        self._peers.stop()

    def rekey(self, newest: bytes, *older: bytes) -> None:
        """Go by another secret of the team (32 bytes) from now on; sessions live on.

        What this node begins is under the ``newest``; what others begin may be under one of the ``older`` ones too,
        while not everybody has heard, and who does not answer to the one is asked under the next.  Raises
        ``ValueError`` for what is no secret.
        """
        secrets = checked_secrets([newest, *older])
        self._peers.rekey([Credentials.of(self._identity, secret) for secret in secrets])
        self._own = self._peers.ring[0]

    def evict(self, public: bytes, code: str = REVOKED) -> None:
        """Have nothing more to do with a peer: it is told ``code``, and what is asked of it fails with ``NotAdmitted``.

        That it does not come in again is for the door to say.
        """
        peer = self._peers.known(public)
        if peer is not None and peer.session is not None:
            self._refuse(peer.session, code)
        else:
            self._part(public, f"{public.hex()[:16]} is not let in: {meaning(code)}", code)

    def route(self, kind: int, receiver: Callable[[bytes, Address], None]) -> None:
        """Hand datagrams with the first byte ``kind`` to ``receiver``; raises ``ValueError`` for one that is taken."""
        if kind in self._receivers:
            raise ValueError(f"datagrams of the kind {kind:#x} have their receiver")
        self._receivers[kind] = receiver

    def post(self, datagram: bytes, to: Address) -> None:
        """Send a datagram of a routed kind as it is; without effect while the endpoint is not running."""
        if self.is_running:
            self._network.send(datagram, to)

    def expose(
        self,
        name: str,
        answer: Callable[..., object],
        changes: bool = False,
        idempotent: bool = False,
        early: bool = False,
    ) -> None:
        """Let peers call ``answer(peer, *arguments)`` under ``name``.

        It returns something that msgpack can hold (``MAX_MESSAGE`` at most), a Deferred or a coroutine of it, or raises
        ``Refused``: the asker gets it with its code and its text.
        Arguments that do not fit the function's parameters and plain annotations are refused before it runs; other
        exceptions are logged, and the asker gets ``Refused("internal error")``.  It runs only in an established
        session, and with ``changes`` at most once for each question; a repeated one is given the answer of the first.
        Say ``idempotent`` as well where a second run does no harm: then nothing need be kept of the first.

        With ``early`` it may also run for a question that came with an INIT, which saves a round trip.  Anybody may
        send a recorded INIT from a forged address, so an early method only reads, sends nothing, and returns its
        result, not a Deferred; ``ValueError`` where it ``changes`` something.

        When the asker gives up or its time is over, a Deferred or coroutine is cancelled.  A function with a
        keyword-only parameter ``deadline`` gets that moment, in seconds of this node's clock (infinite where none).
        """
        self._answerer.methods[name] = Method(name, answer, changes, idempotent, early)

    def route_inside(self, kind: int, receiver: Inside) -> None:
        """Hand what peers send in confirmed sessions with this first byte to ``receiver``.

        Such a datagram does not move its peer's address, for it may come by another way than the usual one.
        """
        self._inside[kind] = receiver

    def send_inside(self, session: Session, plain: bytes, to: Address | None = None) -> None:
        """Seal ``plain`` for the peer of a session and send it where the peer is, or ``to`` another address of it."""
        if self.is_running:
            self._network.send(self._sealed(session, plain), to or session.contact.address)

    @property
    def peers(self) -> Peers:
        """What is remembered of the others."""
        return self._peers

    def ask(
        self,
        contact: Contact,
        method: str,
        *arguments: object,
        timeout: float | None = None,
        changes: bool = False,
        is_light: bool = False,
    ) -> Deferred[Any]:
        """Ask a peer, and try again until it answers, at most four times and for ``timeout`` seconds.

        Question and answer may have ``MAX_MESSAGE`` bytes; what does not fit into a datagram goes as a parcel.  Of many
        questions to one peer the later ones wait for their turn.  Without ``timeout`` the answer has 1.5 s, counted
        from that turn and anew at each sign that a parcel makes progress.  With a longer one the tries are spread over
        it, for methods that take their time.  Say ``changes`` where the method changes
        something: such a question waits for the session, others ride in the handshake.  For one that ``is_light`` no
        session is opened beside the one that there is, however silent the peer.

        Fails with ``NoAnswer``, ``Refused`` (the peer's code and text), ``TooLarge``, ``Crowded``, ``NotAdmitted``,
        ``NotRunning``, or with the ``TypeError`` of arguments that msgpack cannot hold.  When it is
        cancelled, the peer is told and cancels its work.
        """
        if not self.is_running:
            return defer.fail(NotRunning("the endpoint is not running; start it first"))
        return self._asker.ask(contact, method, arguments, timeout, changes, is_light)

    def tell(self, contact: Contact, method: str, *arguments: object) -> None:
        """Call a peer's method once, without answer and without a second try; raises ``TooLarge`` and ``NotRunning``.

        It must fit into one datagram.  Opens a session first where there is none.
        """
        if not self.is_running:
            raise NotRunning("the endpoint is not running; start it first")
        self._asker.tell(contact, method, arguments)

    def is_met(self, contact: Contact) -> bool:
        """Whether there is a session with ``contact``, so that a question needs one round trip and no handshake."""
        peer = self._peers.known(contact.public)
        return peer is not None and self._peers.is_in_touch(peer)

    def round_trip(self, contact: Contact) -> float | None:
        """How long an answer of ``contact`` takes, in seconds, or None where nobody was timed yet."""
        peer = self._peers.known(contact.public)
        return None if peer is None else peer.round_trip.mean

    @property
    def traffic(self) -> Mapping[str, int]:
        """What the network underneath counts (``sent``, ``received``, ...); empty where it counts nothing."""
        return dict(getattr(self._network, "counters", {}))

    def greet(self, address: Address, timeout: float = PATIENCE) -> Deferred[Contact]:
        """Learn who listens at ``address``; fails with ``NoAnswer``.  The contact has not proved its key yet."""
        if not self.is_running:
            return defer.fail(NotRunning("the endpoint is not running; start it first"))
        return self.greeter.greet(address, timeout)

    def overhear(self, datagram: bytes, source: Address) -> None:
        """Take a datagram that came by another way than the node's own port; answers leave by that port."""
        if self.is_running:
            self._received(datagram, source)

    def let_go(self, seconds: float) -> None:
        """Forget the sessions on which nothing was heard for so long, where nobody waits for anything from the peer.

        The other side does the same, or finds out by its next question in vain: either opens another one when it is
        wanted.
        """
        now = self._clock.seconds()
        self._half_open.sweep(now)
        self._answerer.tidy(now)
        for public in self._peers.let_go(now - seconds):
            self._courier.let_go(public)
            self.on_let_go(public)

    def reopen(self, contact: Contact) -> None:
        """Open a session at the contact's address, though there may be one elsewhere; the newest one is used."""
        if self.is_running:
            self._peers.open(self._peers.peer(contact), contact.address)

    def hail(self, address: Address, timeout: float = PATIENCE) -> Deferred[Echo]:
        """Ask who is at ``address`` at all, of whatever team; fails with ``NoAnswer``.  Anybody may have said it."""
        if not self.is_running:
            return defer.fail(NotRunning("the endpoint is not running; start it first"))
        return self.hailer.hail(address, timeout)

    def _count(self, reason: str) -> None:
        if reason:
            self.counters[reason] += 1

    def _received(self, datagram: bytes, source: Address) -> None:
        if len(datagram) > MAX_DATAGRAM and not (datagram[0] == DATA and len(datagram) <= MAX_CARRIED):
            self.counters["oversized"] += 1
            return
        receiver = self._receivers.get(datagram[0]) if datagram else None
        if receiver is None:
            self.counters["unknown"] += 1
        elif self.is_running:
            receiver(datagram, source)

    def _on_data(self, datagram: bytes, source: Address) -> None:
        if len(datagram) < OVERHEAD:
            self.counters["malformed"] += 1
            return
        session = self._sessions.get(index_of(datagram))
        if session is None:
            self.counters["stale"] += 1
            return
        if session.is_replay(datagram):
            self.counters["replayed"] += 1
            return
        try:
            data, ahead = session.open(datagram)
        except Forged:
            self.counters["forged"] += 1
            return
        self._peers.loss.arrived(ahead)
        session.heard_at = self._clock.seconds()
        if data[:1] == _REFUSAL:
            self._turned_away(session, data[1:])
            return
        if session.is_over:
            self._refuse(session, SUPERSEDED)
            return
        inside = self._inside.get(data[0]) if data else None
        if ahead > 0 and source != session.contact.address and inside is None:
            session.contact = Contact(session.contact.public, source)
            self._peers.moved(session)
        if not session.is_confirmed:
            code = self._judged(session.contact.public, session.shown, session.life, self.door.admit)
            session.shown = b""
            if code:  # two of them knocked at once, or there is no room to remember it
                self._refuse(session, code)
                return
            self._half_open.confirm(session)
            self._established(session, is_owed=False)
            self._peers.confirmed(session)
            self.on_contact(session.contact)
        if not data or not self.is_running:
            return
        if inside is not None:
            inside(session, data, source)
        elif len(datagram) > MAX_DATAGRAM:
            self.counters["oversized"] += 1
        elif data[0] == PART:
            self._courier.on_part(session, data)
        elif data[0] == RECEIPT:
            self._courier.on_receipt(session, data)
        else:
            self._read(data, session)

    def _read(self, data: bytes, session: Session) -> None:
        try:
            message = decoded(data)
        except Malformed:
            self.counters["malformed"] += 1
            return
        if isinstance(message, Question):
            self._answerer.answer(message, session)
        elif isinstance(message, Told):
            self._answerer.take(message, session.contact)
        elif isinstance(message, Cancel):
            self._answerer.cancel(message, session.contact.public)
        else:
            self._resolve(message, session.contact)

    def _on_parcel(self, session: Session, key: Key, data: bytes) -> None:
        """Take a message that arrived in parts; it must be what its parcel said."""
        try:
            message = decoded(data)
        except Malformed:
            self.counters["malformed"] += 1
            return
        if isinstance(message, Question) and key == (False, message.id):
            self._answerer.answer(message, session, is_bulky=True)
        elif isinstance(message, Answer | Failure) and key == (True, message.id):
            self._resolve(message, session.contact)
        else:
            self.counters["malformed"] += 1

    def _established(self, session: Session, is_owed: bool) -> None:
        self.refusals.pop(session.contact.public, None)
        peer = self._peers.established(session)
        if self._lives.met(session.contact.public, session.life):
            for other in peer.sessions:
                other.is_over = other.life != session.life
        self._courier.restart(peer.public)
        self._asker.established(peer, session, is_owed)

    def _resolve(self, message: Answer | Failure, contact: Contact) -> None:
        if self._asker.is_asked(message.id, contact.public):
            self.on_contact(contact)
        self._asker.resolve(message, contact.public)

    def _on_init(self, datagram: bytes, source: Address) -> None:
        own = None
        if INIT_LEAST + self.door.room <= len(datagram) <= MAX_DATAGRAM:
            for own in self._peers.ring:  # written out: this is all that a forged INIT shall cost
                if is_init_of_team(own, datagram):
                    break
            else:
                own = None
        if own is None:
            self.counters["forged"] += 1
            return
        now = self._clock.seconds()
        if not self._cookies.is_lawful(datagram, source, now):
            self.counters["forged"] += 1
            return
        known = self._half_open.response(datagram, now)
        if known is not None:  # the RESP was lost, or somebody plays a recording: neither costs a key exchange
            self.counters["repeated"] += 1
            self._network.send(known, source)
            return
        if not self._cookies.admits(datagram, source, now):
            self.counters["crowded"] += 1
            self._network.send(self._cookies.reply(datagram, source, now, own.cookie_key), source)
            return
        try:
            acceptance = Acceptance(own, datagram, self._rng.randbytes(32))
        except Forged:
            self.counters["forged"] += 1
            return
        response = self._admitted(acceptance, source, now)
        if response and self.is_running:
            self._half_open.answered(datagram, response, now)
            self._network.send(response, source)

    def _admitted(self, acceptance: Acceptance, source: Address, now: float) -> bytes:
        """The RESP for who proved its key by an INIT; nothing where that is a recording, or its message malformed."""
        contact, hello = self._peers.contact(acceptance.public, source), self._peers.hello
        code = self._judged(contact.public, acceptance.shown, acceptance.life, self.door.judge)
        if code:  # that is all that comes of it: it may be a recording, with a pass that was succeeded since
            self.counters["refused"] += 1
            self._say_refusing(contact, code)
            if code not in (DOUBLED, SUPERSEDED):  # who plays a recording shall not make people look for a copy
                self._met("we", contact, code)
            return acceptance.refuse(code, source, hello.life)
        if not self._stamps.take(contact.public, acceptance.life, acceptance.stamp):
            self.counters["replayed"] += 1
            return b""
        try:
            rider = decoded(acceptance.rider) if acceptance.rider else None
        except Malformed:
            self.counters["malformed"] += 1
            return b""
        answer = b""
        if isinstance(rider, Question):
            answer = self._answerer.ride(rider, contact, acceptance.answer_room(hello))
        if not self.is_running:
            return b""  # the method stopped us
        index = self._peers.new_index()
        response, keys = acceptance.accept(index, answer, source, hello)
        session = Session(contact, index, acceptance.remote_index, keys, now, is_confirmed=False, life=acceptance.life)
        session.shown = acceptance.shown
        self._half_open.add(session, now)
        return response

    def _on_resp(self, datagram: bytes, source: Address) -> None:
        if len(datagram) < RESP_LEAST:
            self.counters["malformed"] += 1
            return
        opening = self._peers.opening(index_of(datagram))
        if opening is None:
            self.counters["stale"] += 1
            return
        if source not in opening.doors:
            self.counters["misdirected"] += 1
            return
        try:
            reply = opening.invitation.accepted(datagram)
        except Forged:
            self.counters["forged"] += 1
            return
        contact = self._peers.contact(opening.peer.public, source)
        index = opening.invitation.local_index
        self._peers.accepted(opening)
        if reply.refusal:
            self._refused_by(contact, reply.refusal)
            return
        session = Session(
            contact, index, reply.remote_index, reply.keys, self._clock.seconds(), is_confirmed=True, life=reply.life
        )
        code = self._judged(contact.public, reply.shown, reply.life, self.door.admit)
        if code:
            self._refuse(session, code)
            return
        self._sessions[index] = session
        self.on_contact(contact)
        if reply.seen is not None:
            self.on_seen(contact, reply.seen)
        message: object = None
        if reply.message:
            try:
                message = decoded(reply.message)
            except Malformed:
                self.counters["malformed"] += 1
        if isinstance(message, Answer | Failure):
            self._asker.resolve(message, contact.public)
        if self.is_running:
            self._established(session, is_owed=True)

    # -- who is let in ----------------------------------------------------------------------------------------------

    def _judged(self, public: bytes, shown: bytes, life: Life, judge: Callable[[bytes, bytes], str]) -> str:
        if len(shown) > self.door.room:
            return FOREIGN
        return self._lives.judge(public, life) or judge(public, shown)

    def _refuse(self, session: Session, code: str) -> None:
        """Tell a peer on ``session`` that it is not let in, and have nothing more to do with it."""
        contact = session.contact
        self._send(session, _REFUSAL + code.encode("ascii"))
        self.counters["refused"] += 1
        self._say_refusing(contact, code)
        self._met("we", contact, code)
        self.on_refusing(contact, code)
        self._half_open.forget(session)
        self._peers.drop(session)
        peer = self._peers.known(contact.public)
        if code not in (DOUBLED, SUPERSEDED) or peer is None or not peer.sessions:
            self._part(contact.public, f"{contact.address} is not let in: {meaning(code)}", code)

    def _turned_away(self, session: Session, said: bytes) -> None:
        """Take it from a peer that it does not let us in."""
        code = said.decode("ascii", errors="replace")
        if not is_refusal(code):
            self.counters["malformed"] += 1
            return
        self._peers.drop(session)
        self._refused_by(session.contact, code)

    def _refused_by(self, contact: Contact, code: str) -> None:
        text = f"{contact.address} does not let this node in: {meaning(code)}"
        self._met("they", contact, code)
        if self._is_news(contact.public, code, True):
            self._log.warn("{text}", text=text, code=code)
        self._part(contact.public, text, code)
        keep(self.refusals, contact.public, (contact, code), MAX_REFUSALS)
        self.on_refused(contact, code)

    def _part(self, public: bytes, text: str, code: str) -> None:
        """Forget everything that is under way with a peer; what is asked of it fails."""
        self._half_open.drop(public)
        self._answerer.evict(public)
        peer = self._peers.known(public)
        if peer is not None:
            self._peers.evict(peer)
            self._asker.refused(peer, lambda: NotAdmitted(text, code))
        self._courier.evict(public)

    def _met(self, side: Side, contact: Contact, code: str) -> None:
        self.rebuffs.met(contact.public, str(contact.address), side, code, meaning(code), self._clock.seconds())

    def _say_refusing(self, contact: Contact, code: str) -> None:
        if self._is_news(contact.public, code):
            who, why = contact.public.hex()[:16], meaning(code)
            self._log.warn("{who} at {at} is not let in: {why}", who=who, at=contact.address, why=why, code=code)

    def _is_news(self, *what: object) -> bool:
        return self._noted.is_new(self._clock.seconds(), *what)

    def _may_not(self, peer: Contact, method: str) -> None:
        self._met("call", peer, ROLE)
        if self._is_news(peer.public, ROLE):
            who, why = peer.public.hex()[:16], meaning(ROLE)
            self._log.warn(
                "{who} at {at} may not call {method}: {why}",
                who=who,
                at=peer.address,
                method=method,
                why=why,
                code=ROLE,
            )

    # -- sending ----------------------------------------------------------------------------------------------------

    def _send(self, session: Session, message: bytes) -> None:
        if self.is_running:
            self._network.send(self._sealed(session, message), session.contact.address)

    def _sealed(self, session: Session, message: bytes) -> bytes:
        self._peers.renew(session)
        return session.seal(message)

    def _send_to(self, public: bytes, message: bytes) -> None:
        """Send on the newest session with a peer; where there is none the message is lost, as datagrams may be."""
        peer = self._peers.known(public)
        if peer is not None and peer.session is not None:
            self._send(peer.session, message)
