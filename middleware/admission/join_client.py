"""Client side of admission: send join requests to bootstrap nodes, one after the other, until one replies.

The client needs a code and one or more addresses, and returns a ``Membership``.
"""

from __future__ import annotations

import random
from collections.abc import Iterable

from nacl import bindings
from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IDelayedCall, IReactorTime

from middleware.admission import join_codec
from middleware.admission.certificate import verify_certificate
from middleware.admission.errors import NotWelcome
from middleware.admission.join_code import JoinCode, TermsContent
from middleware.admission.join_codec import JoinReply, UnsignedRefusal
from middleware.admission.membership_file import Membership
from middleware.entangled.errors import NoAnswer, RemoteError
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address, Network

JOIN_TIMEOUT_S = 20.0
"""Seconds until a newcomer gives up."""
FIRST_RETRY_S, RETRY_GROWTH, TRIES_PER_ADDRESS = 0.25, 1.6, 4
"""Seconds until a request is repeated, growth factor of that delay, and number of successive requests to one
address."""
FINAL_REFUSALS = ("used", "expired", "early", "revoked", "name", "foreign")
"""Refusals that every bootstrap node would give."""
MAX_ADDRESSES = 64


class JoinClient:
    """Join a team with a code; ``seed`` is the node's lasting identity, ``requested_name`` the name that it asks for.

    The newcomer owns ``network`` while it joins, and closes it afterwards.
    """

    def __init__(
        self,
        code: JoinCode,
        seed: bytes,
        network: Network,
        clock: IReactorTime,
        rng: random.Random,
        requested_name: str = "",
    ) -> None:
        self._code = code
        self._key = code.key
        self._seed = seed
        self._public = Identity(seed).public
        self._network = network
        self._clock = clock
        self._ephemeral = rng.randbytes(32)
        shared = bindings.crypto_scalarmult_base(self._ephemeral)
        self._request = join_codec.make_request(self._key, self._public, shared, requested_name, rng)
        self._addresses: list[Address] = []
        self._address_index = self._tries = 0
        self._retry_delay = FIRST_RETRY_S
        self._last_refusal = ""
        self._retry_call: IDelayedCall | None = None
        self._timeout_call: IDelayedCall | None = None
        self._done: Deferred[Membership] | None = None

    def join(self, addresses: Iterable[Address], timeout: float = JOIN_TIMEOUT_S) -> Deferred[Membership]:
        """Send requests to ``addresses`` until a bootstrap node admits the newcomer.

        Fails with ``NotWelcome``, or with ``NoAnswer`` if there is no reply within ``timeout`` seconds; raises
        ``PortInUse``.
        """
        self._done = Deferred(self._on_cancel)
        self._network.listen(self._on_datagram)
        self._timeout_call = self._clock.callLater(timeout, self._on_timeout)
        for address in addresses:
            self.add_address(address)
        return self._done

    def add_address(self, address: Address) -> None:
        """Add an address, such as one discovered on the local network."""
        if address not in self._addresses and len(self._addresses) < MAX_ADDRESSES:
            self._addresses.append(address)
            if self._retry_call is None and self._done is not None:
                self._send_request()

    def _send_request(self) -> None:
        self._network.send(self._request, self._addresses[self._address_index % len(self._addresses)])
        self._tries += 1
        wait, self._retry_delay = self._retry_delay, self._retry_delay * RETRY_GROWTH
        if self._tries >= TRIES_PER_ADDRESS:
            self._select_next_address()
        self._retry_call = self._clock.callLater(wait, self._send_request)

    def _select_next_address(self) -> None:
        self._address_index, self._tries, self._retry_delay = self._address_index + 1, 0, FIRST_RETRY_S

    def _on_datagram(self, datagram: bytes, source: Address) -> None:
        if self._done is None or datagram[:1] != bytes([join_codec.JOIN_REPLY]) or source not in self._addresses:
            return
        try:
            reply = join_codec.open_reply(datagram, self._code, self._public, self._ephemeral)
        except RemoteError:
            return  # a member that is not a bootstrap node may have sent it; the valid reply can still arrive
        if isinstance(reply, UnsignedRefusal):
            self._try_next(reply.code, source)
        elif isinstance(reply.content, JoinReply):
            self._accept_reply(reply.terms, reply.content, source)
        elif reply.content in FINAL_REFUSALS:
            self._fail(NotWelcome(reply.content))
        else:
            self._try_next(reply.content, source)

    def _try_next(self, code: str, source: Address) -> None:
        """Try the next address, because its node may admit the newcomer; the current address is tried again later."""
        self._last_refusal = code
        if source == self._addresses[self._address_index % len(self._addresses)]:
            self._select_next_address()

    def _accept_reply(self, terms: TermsContent, reply: JoinReply, source: Address) -> None:
        try:
            member = verify_certificate(terms.operator, self._public, reply.certificate)
        except RemoteError:
            return
        if member.invitation != self._key.public:
            return
        known = dict.fromkeys([source, *(contact.address for contact in reply.contacts)])
        secrets = tuple(sorted(reply.secrets, key=lambda each: -each[0]))
        membership = Membership(
            terms.team, self._seed, terms.operator, reply.certificate, secrets, tuple(known), dict(terms.settings)
        )
        done = self._finish()
        if done is not None:
            done.callback(membership)

    def _on_timeout(self) -> None:
        if self._last_refusal:
            self._fail(NotWelcome(self._last_refusal))
            return
        addresses = ", ".join(map(str, self._addresses)) or "no bootstrap node found"
        remedy = "give the address of a running bootstrap node (swarm join CODE --at HOST:PORT)"
        self._fail(NoAnswer(f"no reply to the join request ({addresses}); {remedy}, and check that UDP is not blocked"))

    def _fail(self, error: Exception) -> None:
        done = self._finish()
        if done is not None:
            done.errback(error)

    def _on_cancel(self, _: object) -> None:
        self._finish()

    def _finish(self) -> Deferred[Membership] | None:
        done, self._done = self._done, None
        for call in (self._retry_call, self._timeout_call):
            if call is not None and call.active():
                call.cancel()
        self._network.close()
        return done
