"""Server side of admission: a bootstrap node verifies join requests and admits newcomers (thesis, Figure 4.5).

A request with an unknown invitation costs one table lookup, and a request that cannot be decrypted costs one hash.  The
server stores state only for requests that pass these checks.  Each request gets at most one reply, which is never
longer than the request.
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

from middleware.admission import join_codec
from middleware.admission.certificate import BOOTSTRAP, MAX_CLOCK_SKEW_S, is_join_signature, issue_certificate
from middleware.admission.errors import REFUSAL_TEXTS
from middleware.admission.join_codec import JoinReply, JoinRequest, Signer
from middleware.admission.membership_list import MembershipList, invitation_id, pack_admission
from middleware.admission.statement import NAME_PREFIX_LETTERS, Invite
from middleware.entangled.errors import EntangledError, RemoteError
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address
from middleware.entangled.token_bucket import TokenBucket
from middleware.entangled.wire.admission_check import LogLimiter

MAX_REQUESTS_PER_S = 50.0
"""Join requests per second with a signature check; these take 1 % of a core."""
MAX_UNSIGNED_REFUSALS_PER_S = 20.0
"""Hints per second to join requests with an unknown invitation id."""
MAX_CACHED_REPLIES = 256


class AdmissionServer:
    """Admits newcomers at a bootstrap node.

    ``identity`` is the node's key pair.  ``take_use`` uses up one use of an invitation, ``publish_admission`` publishes
    an admission, ``build_reply`` returns the reply content for a certificate, and ``send`` sends a datagram.  ``now``
    is the monotonic clock for rate limits, ``wall`` the wall clock for statements.  ``on_refused`` is called for each
    rejected newcomer with its key (empty if the code is unknown), its address and the code of ``REFUSAL_TEXTS``.
    """

    _log = Logger()

    def __init__(
        self,
        membership_list: MembershipList,
        identity: Identity,
        take_use: Callable[[Invite], Deferred[bool]],
        publish_admission: Callable[[bytes], object],
        build_reply: Callable[[bytes], JoinReply],
        send: Callable[[bytes, Address], None],
        now: Callable[[], float],
        wall: Callable[[], float],
        rng: random.Random,
        on_refused: Callable[[bytes, Address, str], None],
    ) -> None:
        self._membership_list = membership_list
        self._identity = identity
        self._take_use = take_use
        self._publish_admission = publish_admission
        self._build_reply = build_reply
        self._send = send
        self._now = now
        self._wall = wall
        self._rng = rng
        self._cached_replies: OrderedDict[bytes, bytes] = OrderedDict()
        self._pending_names: dict[bytes, str] = {}
        self._on_refused = on_refused
        self._log_limiter = LogLimiter()
        self._request_rate = TokenBucket(MAX_REQUESTS_PER_S)
        self._unsigned_refusal_rate = TokenBucket(MAX_UNSIGNED_REFUSALS_PER_S)

    def on_request(self, datagram: bytes, source: Address) -> None:
        """Handle a JOIN_REQUEST; never raises because of its content."""
        digest = hashlib.blake2s(datagram, digest_size=16).digest()
        answer = self._cached_replies.get(digest)
        if answer is not None:
            self._send(answer, source)
            return
        try:
            name = join_codec.read_invitation_id(datagram)
            known = self._membership_list.find_invitation(name)
            if known is None:
                if self._unsigned_refusal_rate.take(self._now()):
                    self._log_refusal(name, "unknown", source)
                    self._send(join_codec.make_unsigned_refusal(name), source)
                return
            invite, packed = known
            request = join_codec.open_request(datagram, invite.public)
            # Checked after decryption: a node that only saw the id must not use up the rate of code holders.
            if not self._request_rate.take(self._now()):
                return
            if not is_join_signature(invite.public, request.public, request.requested_name, request.proof):
                return
        except RemoteError:
            return
        if request.public in self._pending_names:
            return  # the newcomer retransmits
        self._pending_names[request.public] = ""
        decided = Deferred.fromCoroutine(self._decide_request(request, invite, packed))
        decided.addBoth(self._reply, request, invite, digest, source).addErrback(self._log_unexpected)

    async def _decide_request(self, request: JoinRequest, invite: Invite, packed: bytes) -> bytes | str:
        """Return the certificate of the newcomer, or the code of the refusal."""
        now = int(self._wall())
        me, own = (
            self._membership_list.find_grant(self._identity.public),
            self._membership_list.find_member(self._identity.public, now),
        )
        if me is None or own is None or BOOTSTRAP not in me[0].roles or self._membership_list.find_refusal(own, now):
            return "role"
        if self._membership_list.find_terms(invite.public) is None:
            return "old"
        if (
            self._membership_list.find_revocation(invite.public) is not None
            or self._membership_list.find_revocation(request.public) is not None
        ):
            return "revoked"
        before = self._membership_list.find_admission(request.public)
        if before is not None and before.member.invitation == invite.public:
            return before.certificate
        if now < invite.not_before - MAX_CLOCK_SKEW_S:
            return "early"
        if now >= invite.not_after:
            return "expired"
        if (
            sum(each.member.invitation == invite.public for each in self._membership_list.list_admissions())
            >= invite.uses
        ):
            return "used"
        name = self._choose_name(request, invite)
        if name is None:
            return "name"
        self._pending_names[request.public] = name
        try:
            if not await self._take_use(invite):
                return "used"
        except EntangledError:
            return "later"
        applicant = (request.public, request.requested_name, request.proof)
        begin = max(now, invite.not_before)
        certificate = issue_certificate(self._identity, me[1], (packed, invite), applicant, name, begin)
        self._publish_admission(pack_admission(request.public, certificate))
        return certificate

    def _choose_name(self, request: JoinRequest, invite: Invite) -> str | None:
        """Choose the newcomer's name; None if another member has it already."""
        taken = {
            member.name
            for member in self._membership_list.list_members(self._wall())
            if member.public != request.public
        }
        taken.update(self._pending_names.values())
        if invite.uses == 1:
            return invite.name if invite.name not in taken else None
        if request.requested_name:
            return request.requested_name if request.requested_name not in taken else None
        free = (f"{invite.name[:NAME_PREFIX_LETTERS]}-{number}" for number in range(1, len(taken) + 2))
        return next((name for name in free if name not in taken), None)

    def _reply(
        self, result: bytes | str | Failure, request: JoinRequest, invite: Invite, digest: bytes, source: Address
    ) -> Any:
        del self._pending_names[request.public]
        if isinstance(result, Failure):
            result.trap(EntangledError)
            self._log.warn("cannot admit a newcomer: {problem}", problem=result.getErrorMessage())
            result = "later"
        signer = self._make_signer(invite)
        if isinstance(result, bytes) and signer is not None:
            answer = join_codec.make_reply(invite.public, request, self._build_reply(result), signer, self._rng)
            self._log.info(
                "admitted by the invitation of {name}: {public}", name=invite.name, public=request.public.hex()
            )
        else:
            code = result if isinstance(result, str) else "role"
            self._log_refusal(request.public, code, source, invite.name)
            if signer is None:
                answer = join_codec.make_unsigned_refusal(invitation_id(invite.public), code)
            else:
                answer = join_codec.make_refusal(invite.public, request, code, signer, self._rng)
        if result not in ("later", "role", "name", "old"):  # these can change at any time
            self._cached_replies[digest] = answer
            if len(self._cached_replies) > MAX_CACHED_REPLIES:
                self._cached_replies.popitem(last=False)
        self._send(answer, source)
        return None

    def _make_signer(self, invite: Invite) -> Signer | None:
        """Return the signer of a reply; None if this node is not a bootstrap node or lacks the terms."""
        me, terms = (
            self._membership_list.find_grant(self._identity.public),
            self._membership_list.find_terms(invite.public),
        )
        if me is None or BOOTSTRAP not in me[0].roles or terms is None:
            return None
        return Signer(self._identity, me[1], terms)

    def _log_unexpected(self, failure: Failure) -> None:
        if failure.check(RemoteError) is None:  # an invalid ephemeral key is the newcomer's error
            self._log.failure("while admitting a newcomer", failure)

    def _log_refusal(self, public: bytes, code: str, source: Address, name: str = "") -> None:
        """Log a refusal once per newcomer and reason; a rate limit protects the log from invented ids."""
        self._on_refused(b"" if code == "unknown" else public, source, code)
        if not self._log_limiter.should_log(self._now(), public, code):
            return
        via = f" by the invitation of {name}" if name else ""
        self._log.warn(
            "rejected{via}, from {source}: {code}: {why}", via=via, source=source, code=code, why=REFUSAL_TEXTS[code]
        )
