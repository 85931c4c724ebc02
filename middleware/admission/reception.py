"""Server side of admission: a bootstrap node verifies join requests and admits newcomers (thesis, Figure 4.5).

A request that names an unknown invitation costs one table lookup, and one that does not decrypt costs one hash.  State
is kept only after that, and each request gets at most one reply, never longer than the request.
"""

from __future__ import annotations

import hashlib
import random
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

from twisted.internet.defer import Deferred
from twisted.logger import Logger
from twisted.python.failure import Failure

from middleware.admission import knock
from middleware.admission.certificate import BOOTSTRAP, SKEW, chained, is_proof
from middleware.admission.errors import WHY
from middleware.admission.knock import Knock, Signer, Welcome
from middleware.admission.roll import Roll, invitation_id, packed_admission
from middleware.admission.statement import NUMBERED, Invite
from middleware.entangled.errors import EntangledError, RemoteError
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address
from middleware.entangled.token_bucket import TokenBucket
from middleware.entangled.wire.door import Noted

RATE = 50.0
"""Join requests per second with a signature check; these take 1 % of a core."""
HINTS = 20.0
"""Hints per second to join requests with an unknown invitation id."""
MAX_ANSWERS = 256


class Reception:
    """Admit newcomers at a bootstrap node.

    ``identity`` is the node's key pair.  ``take`` uses up one use of an invitation, ``admit`` publishes an admission,
    ``given`` returns the reply content for a pass, and ``send`` sends a datagram.  ``now`` is the monotonic clock for
    rate limits, ``wall`` the wall clock for statements.  ``refused`` is called for each rejected newcomer with its key
    (empty if the code is unknown), its address and the code of ``WHY``.
    """

    _log = Logger()

    def __init__(
        self,
        roll: Roll,
        identity: Identity,
        take: Callable[[Invite], Deferred[bool]],
        admit: Callable[[bytes], object],
        given: Callable[[bytes], Welcome],
        send: Callable[[bytes, Address], None],
        now: Callable[[], float],
        wall: Callable[[], float],
        rng: random.Random,
        refused: Callable[[bytes, Address, str], None],
    ) -> None:
        self._roll = roll
        self._identity = identity
        self._take = take
        self._admit = admit
        self._build_welcome = given
        self._send = send
        self._now = now
        self._wall = wall
        self._rng = rng
        self._answers: OrderedDict[bytes, bytes] = OrderedDict()
        self._under_way: dict[bytes, str] = {}
        self._on_refused = refused
        self._logged = Noted()
        self._request_rate = TokenBucket(RATE)
        self._hint_rate = TokenBucket(HINTS)

    def on_knock(self, datagram: bytes, source: Address) -> None:
        """Handle a KNOCK; never raises because of its content."""
        digest = hashlib.blake2s(datagram, digest_size=16).digest()
        answer = self._answers.get(digest)
        if answer is not None:
            self._send(answer, source)
            return
        try:
            name = knock.id_of(datagram)
            known = self._roll.invited(name)
            if known is None:
                if self._hint_rate.take(self._now()):
                    self._log_refusal(name, "unknown", source)
                    self._send(knock.hint(name), source)
                return
            invite, packed = known
            request = knock.opened_knock(datagram, invite.public)
            # Checked after decryption: a node that only saw the id must not use up the rate of code holders.
            if not self._request_rate.take(self._now()):
                return
            if not is_proof(invite.public, request.public, request.wish, request.proof):
                return
        except RemoteError:
            return
        if request.public in self._under_way:
            return  # the newcomer retransmits
        self._under_way[request.public] = ""
        decided = Deferred.fromCoroutine(self._decide_request(request, invite, packed))
        decided.addBoth(self._reply, request, invite, digest, source).addErrback(self._log_unexpected)

    async def _decide_request(self, request: Knock, invite: Invite, packed: bytes) -> bytes | str:
        """Return the pass of the newcomer, or the code of the refusal."""
        now = int(self._wall())
        me, own = self._roll.granted(self._identity.public), self._roll.member(self._identity.public, now)
        if me is None or own is None or BOOTSTRAP not in me[0].roles or self._roll.refusal(own, now):
            return "role"
        if self._roll.terms_of(invite.public) is None:
            return "old"
        if self._roll.revoked(invite.public) is not None or self._roll.revoked(request.public) is not None:
            return "revoked"
        before = self._roll.admitted(request.public)
        if before is not None and before.member.invitation == invite.public:
            return before.shown
        if now < invite.not_before - SKEW:
            return "early"
        if now >= invite.not_after:
            return "expired"
        if sum(each.member.invitation == invite.public for each in self._roll.admissions()) >= invite.uses:
            return "used"
        name = self._choose_name(request, invite)
        if name is None:
            return "name"
        self._under_way[request.public] = name
        try:
            if not await self._take(invite):
                return "used"
        except EntangledError:
            return "later"
        newcomer = (request.public, request.wish, request.proof)
        begin = max(now, invite.not_before)
        shown = chained(self._identity, me[1], (packed, invite), newcomer, name, begin)
        self._admit(packed_admission(request.public, shown))
        return shown

    def _choose_name(self, request: Knock, invite: Invite) -> str | None:
        """Choose the newcomer's name; None if another member has it already."""
        taken = {member.name for member in self._roll.members(self._wall()) if member.public != request.public}
        taken.update(self._under_way.values())
        if invite.uses == 1:
            return invite.name if invite.name not in taken else None
        if request.wish:
            return request.wish if request.wish not in taken else None
        free = (f"{invite.name[:NUMBERED]}-{number}" for number in range(1, len(taken) + 2))
        return next((name for name in free if name not in taken), None)

    def _reply(
        self, result: bytes | str | Failure, request: Knock, invite: Invite, digest: bytes, source: Address
    ) -> Any:
        del self._under_way[request.public]
        if isinstance(result, Failure):
            result.trap(EntangledError)
            self._log.warn("cannot admit a newcomer: {problem}", problem=result.getErrorMessage())
            result = "later"
        signer = self._make_signer(invite)
        if isinstance(result, bytes) and signer is not None:
            answer = knock.welcome(invite.public, request, self._build_welcome(result), signer, self._rng)
            self._log.info(
                "admitted by the invitation of {name}: {public}", name=invite.name, public=request.public.hex()
            )
        else:
            code = result if isinstance(result, str) else "role"
            self._log_refusal(request.public, code, source, invite.name)
            if signer is None:
                answer = knock.hint(invitation_id(invite.public), code)
            else:
                answer = knock.refusal(invite.public, request, code, signer, self._rng)
        if result not in ("later", "role", "name", "old"):  # these can change at any time
            self._answers[digest] = answer
            if len(self._answers) > MAX_ANSWERS:
                self._answers.popitem(last=False)
        self._send(answer, source)
        return None

    def _make_signer(self, invite: Invite) -> Signer | None:
        """Return the signer of a reply; None if this node is not a bootstrap node or lacks the terms."""
        me, terms = self._roll.granted(self._identity.public), self._roll.terms_of(invite.public)
        if me is None or BOOTSTRAP not in me[0].roles or terms is None:
            return None
        return Signer(self._identity, me[1], terms)

    def _log_unexpected(self, failure: Failure) -> None:
        if failure.check(RemoteError) is None:  # an invalid ephemeral key is the newcomer's error
            self._log.failure("while admitting a newcomer", failure)

    def _log_refusal(self, who: bytes, code: str, source: Address, name: str = "") -> None:
        """Log a refusal once per newcomer and reason; a rate limit protects the log from invented ids."""
        self._on_refused(b"" if code == "unknown" else who, source, code)
        if not self._logged.is_new(self._now(), who, code):
            return
        via = f" by the invitation of {name}" if name else ""
        self._log.warn("rejected{via}, from {source}: {code}: {why}", via=via, source=source, code=code, why=WHY[code])
