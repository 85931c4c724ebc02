"""Fuzz certificates, statements, join requests and join replies with changed, truncated and random input.

The first byte of an input selects the kind (see ``KINDS``). If this byte is at least 128, a valid message of the kind
is changed: each following three bytes give the position and value of one change.

Every decoder must return a valid object or raise ``Malformed`` or ``Forged``. The membership list must accept nothing
without the signature of its operator or of a bootstrap node. A bootstrap node's reply to a join request must not be
longer than the request, and the request must cause no exception and no log line.
"""

from __future__ import annotations

import contextlib
import random

from twisted.internet.defer import Deferred, succeed

from middleware.admission import join_codec
from middleware.admission.certificate import verify_certificate, wrap_grant
from middleware.admission.join_code import TermsContent, seal_terms
from middleware.admission.join_codec import JoinReply, JoinRequest, Signer, VerifiedReply, open_reply, open_request
from middleware.admission.membership_list import MembershipList, pack_admission
from middleware.admission.server import AdmissionServer
from middleware.admission.statement import Invite, open_statement
from middleware.entangled.errors import Full, RemoteError
from middleware.entangled.identity import derive_exchange_key
from middleware.entangled.network.network import Address
from tests.fuzz.ground import STRANGER, Violation
from tests.fuzz.raw import RECORDED
from tests.fuzz.runner import main
from tests.middleware.admission.paper import LATER, NOW, admitted, granted, identity, invited, operator

KINDS = ("statement", "pass", "knock", "welcome")
SIGNER = operator(1)
CODE, PACKED, INVITE = invited(SIGNER, "dog")
NEWCOMER = identity("dog")
DICE = random.Random(9)
TERMS = seal_terms(CODE, TermsContent(SIGNER.public, "yard", {"port": 7}), random.Random(8))
INVITATION = SIGNER.invite("dog", ("device",), 1, NOW, LATER, random.Random(1))
ANSWERER = Signer(identity("vaio"), granted(SIGNER, "vaio", "bootstrap"), TERMS)
EPHEMERAL = bytes(range(32))


def lawful() -> dict[str, list[bytes]]:
    """Return valid messages, by kind."""
    grant = granted(SIGNER, "vaio", "bootstrap")
    chain = admitted(SIGNER, "dog")
    secret = SIGNER.rotate_secret(2, [NEWCOMER.public], NOW, 60, random.Random(2))
    end = SIGNER.revoke(identity("cat").public, "cat", NOW)
    knocked = join_codec.make_request(
        CODE.key, NEWCOMER.public, derive_exchange_key(NEWCOMER.public), "", random.Random(3)
    )
    given = JoinReply(chain, ((1, bytes(32), 0),))
    heard = JoinRequest(NEWCOMER.public, derive_exchange_key(NEWCOMER.public), "", b"")
    told = [join_codec.make_reply(INVITE.public, heard, given, ANSWERER, random.Random(4))]
    told += [
        join_codec.make_refusal(INVITE.public, heard, "used", ANSWERER, random.Random(5)),
        join_codec.make_unsigned_refusal(join_codec.read_invitation_id(knocked)),
    ]
    admission = pack_admission(NEWCOMER.public, chain)
    return {
        "statement": [PACKED, grant, secret, end, admission],
        "pass": [chain, wrap_grant(granted(SIGNER, "dog"))],
        "knock": [knocked],
        "welcome": told,
    }


LAWFUL = lawful()
GENUINE = {each for kind in LAWFUL.values() for each in kind}


def changed(base: bytes, data: bytes) -> bytes:
    """Return ``base`` with the changes that ``data`` encodes."""
    found = bytearray(base)
    for place in range(0, len(data) - 2, 3):
        where = int.from_bytes(data[place : place + 2], "little")
        if where >= 0xF000:
            del found[where - 0xF000 :]
        elif found:
            found[where % len(found)] ^= data[place + 2]
    return bytes(found)


def check(data: bytes) -> None:
    """Decode one input with all decoders of its kind; raises ``Violation`` if a decoder breaks a rule."""
    first = data[0] if data else 0
    kind = KINDS[first % len(KINDS)]
    base = LAWFUL[kind][first // len(KINDS) % len(LAWFUL[kind])]
    whole = changed(base, data[1:]) if first >= RECORDED else data[1:]
    {"statement": _statement, "pass": _pass, "knock": _knock, "welcome": _welcome}[kind](whole)


def _statement(whole: bytes) -> None:
    with contextlib.suppress(RemoteError):
        open_statement(SIGNER.public, whole)
        if whole not in GENUINE:
            raise Violation("a statement that nobody signed")
    membership_list = MembershipList(SIGNER.public)
    membership_list.add(LAWFUL["statement"][0], NOW)
    before = (membership_list.digest, len(membership_list))
    try:
        entry = membership_list.add(whole, NOW)
    except (RemoteError, Full):
        entry = None
    if entry is None and (membership_list.digest, len(membership_list)) != before:
        raise Violation("a refused statement changed the roll")
    if entry is not None and whole not in GENUINE:
        raise Violation("the roll believes what nobody signed")


def _pass(whole: bytes) -> None:
    with contextlib.suppress(RemoteError):
        member = verify_certificate(SIGNER.public, NEWCOMER.public, whole)
        if whole not in GENUINE:
            raise Violation(f"a pass that nobody signed makes {member.name} a member")


def _knock(whole: bytes) -> None:
    sent: list[tuple[bytes, Address]] = []
    admissions: list[bytes] = []
    membership_list = MembershipList(SIGNER.public)
    for each in (PACKED, INVITATION.terms, LAWFUL["statement"][1]):
        membership_list.add(each, NOW)

    def take(invite: Invite) -> Deferred[bool]:
        return succeed(True)

    def send(datagram: bytes, to: Address) -> None:
        sent.append((datagram, to))

    def given(shown: bytes) -> JoinReply:
        return JoinReply(shown, ((1, bytes(32), 0),))

    def refused(who: bytes, source: Address, code: str) -> None:
        pass

    bootstrap = AdmissionServer(
        membership_list,
        identity("vaio"),
        take,
        admissions.append,
        given,
        send,
        lambda: 1.0,
        lambda: float(NOW),
        DICE,
        refused,
    )
    bootstrap.on_request(whole, STRANGER)
    if sum(len(datagram) for datagram, _ in sent) > len(whole):
        raise Violation("a knock was answered with more than it had")
    if admissions and whole not in GENUINE:
        raise Violation("somebody was let in by a knock that was changed")
    with contextlib.suppress(RemoteError):
        open_request(whole, INVITE.public)


def _welcome(whole: bytes) -> None:
    with contextlib.suppress(RemoteError):
        found = open_reply(whole, CODE, NEWCOMER.public, NEWCOMER.exchange_secret)
        if isinstance(found, VerifiedReply) and whole not in GENUINE:
            raise Violation("a welcome that nobody said")


if __name__ == "__main__":
    main("paper", check)
