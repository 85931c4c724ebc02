"""A closed team at one node: admission check, membership list, gossip and admission server, connected to the node."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import msgpack
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from middleware.admission import join_codec
from middleware.admission.certificate import Member, extract_entries, issue_guest_certificate
from middleware.admission.closed_admission import ClosedAdmission, start_incarnation
from middleware.admission.errors import REFUSAL_TEXTS, BadKeyFile
from middleware.admission.gossip import COMPARE_INTERVAL_S, Gossip
from middleware.admission.join_codec import JoinReply
from middleware.admission.membership_file import Membership, MembershipStore
from middleware.admission.membership_list import MAX_ENTRIES, Admission, MembershipList, Renewal, invitation_id
from middleware.admission.renewal import Renewer
from middleware.admission.server import AdmissionServer
from middleware.admission.statement import Entry, Grant, Invite, Revocation, Secret
from middleware.entangled.background import Background
from middleware.entangled.contact import Contact
from middleware.entangled.data.store import Store
from middleware.entangled.errors import EntangledError, Full, Refused, RemoteError
from middleware.entangled.identity import Identity, derive_node_id
from middleware.entangled.node import EntangledNode
from middleware.entangled.wire.admission_check import REVOKED, explain

if TYPE_CHECKING:
    from middleware.admission.use_counters import UseCounters

LIST_NOTE = "admission/roll"
"""Name of the stored note with the membership list."""
GUESTS_NOTE, EMPTY_GUESTS = "admission/guests", bytes(msgpack.packb([]))
"""Name of the stored note with certificates of record owners that are not on the membership list."""
MAX_GUESTS = 256
"""Maximum number of stored certificates of owners; others are requested again from members."""


class Team:
    """The closed team of one node: created before the node, which uses its ``admission``; ``attach`` connects them.

    ``membership_store`` stores the node's membership.
    """

    _log = Logger()

    def __init__(
        self, membership_store: MembershipStore, store: Store, wall: Callable[[], float], rng: random.Random
    ) -> None:
        self._membership_store = membership_store
        self._store = store
        self._wall = wall
        self._rng = rng
        self.identity = membership_store.membership.identity
        self.membership_list = MembershipList(membership_store.membership.operator)
        self._load_list()
        self.admission = ClosedAdmission(
            self.membership_list, lambda: self.membership, wall, start_incarnation(store, wall(), rng)
        )
        self._load_guest_certificates()
        self._node: EntangledNode | None = None
        self._use_counters: UseCounters | None = None
        self._accepted_secrets = [secret for _, secret, _ in self.membership.list_accepted_secrets(wall())]

    @property
    def membership(self) -> Membership:
        """This node's current membership."""
        return self._membership_store.membership

    @property
    def secret(self) -> bytes:
        """The newest team secret that this node knows."""
        return self.membership.secrets[0][1]

    def attach(self, node: EntangledNode, clock: IReactorTime) -> None:
        """Connect to ``node``, which uses this team's ``admission`` and is not started yet."""
        self._node, self._clock = node, clock
        self._background = Background(clock)
        endpoint = node.endpoint
        self._gossip = Gossip(
            self.membership_list,
            endpoint,
            node.overlay.contacts,
            self._rng,
            self._background,
            self._wall,
            self._on_new_entry,
        )
        self.admission.publish_entry = self._gossip.add
        self._renewer = Renewer(
            self.membership_list, self.identity, self.admission.find_certificate, self._gossip.add, self._rng
        )
        server = AdmissionServer(
            self.membership_list,
            self.identity,
            lambda invite: self.use_counters.take(invite),
            self._gossip.add,
            self._build_reply,
            endpoint.send_datagram,
            clock.seconds,
            self._wall,
            self._rng,
            lambda public, source, code: endpoint.rejections.record(
                public, str(source), "code", code, REFUSAL_TEXTS[code], clock.seconds()
            ),
        )
        endpoint.route(join_codec.JOIN_REQUEST, server.on_request)
        endpoint.expose("roll.secret", self._answer_secret)
        node.overlay.on_new_contact.add(self._gossip.compare_with)
        if len(self._accepted_secrets) > 1:
            endpoint.replace_secrets(*self._accepted_secrets)

    def start(self) -> None:
        """Start gossip, expiry and renewal."""
        self._evict_former_members()
        self._log.info(
            "member {name} of the closed team {team}", name=self.admission.me.name, team=self.membership.team
        )
        problem = self.admission.me.check_dates(self._wall())
        if problem:
            # The clock may be wrong, so the message contains both causes.
            self._log.warn("the certificate of this node is not valid by its clock: {why}", why=explain(problem))
        self._gossip.start()
        self._background.every(COMPARE_INTERVAL_S, self._run_periodic)

    def stop(self) -> None:
        """Cancel pending work."""
        if self._node is not None:
            self._background.stop()
        if self._use_counters is not None:
            self._use_counters.stop()

    # -- operations of an operator ----------------------------------------------------------------------------------

    @property
    def use_counters(self) -> UseCounters:
        """The use counters of invitations, created on first use."""
        if self._use_counters is None:
            assert self._node is not None
            # Imported here: without join requests the node saves 1 MiB for the tuple space.
            from middleware.admission.use_counters import UseCounters

            self._use_counters = UseCounters(self._node, self._clock, self._rng)
        return self._use_counters

    async def publish(self, packed: bytes) -> str:
        """Publish a statement of the operator; returns its kind.

        An invitation can be used when this is done.  Raises ``Refused`` for a statement that is not of this team.
        """
        check = MembershipList(self.membership_list.operator)
        try:
            entry = check.add(packed, self._wall())
        except RemoteError as error:
            raise Refused(f"{error}; sign with the key of the team {self.membership.team}") from error
        if entry is None:
            raise Refused("the statement has already expired; check the clock of this machine")
        if isinstance(entry, Invite) and self.membership_list.find_invitation(invitation_id(entry.public)) is None:
            await self.use_counters.issue(entry)
        self._gossip.add(packed)
        return entry.slot[0]

    def list_members(self) -> list[Member]:
        """Return the current members that this node knows, by name."""
        return self.membership_list.list_members(self._wall())

    def create_guest(self, seed: bytes, name: str) -> Membership:
        """Return the membership of a guest of this node; raise ``Malformed`` if this node's certificate is too long."""
        own, now = self.membership, int(self._wall())
        certificate = issue_guest_certificate(self.identity, self.admission.own_pass, Identity(seed).public, name, now)
        return replace(own, seed=seed, certificate=certificate, known_nodes=())

    # -- implementation ---------------------------------------------------------------------------------------------

    def _load_list(self) -> None:
        """Load the stored membership list, and add the entries in this node's certificate."""
        try:
            noted = msgpack.unpackb(self._store.get_note(LIST_NOTE) or b"\x90", max_array_len=MAX_ENTRIES)
        except Exception:  # damaged file
            noted = []
        certificate, public = self.membership.certificate, self.identity.public
        for packed in [*(noted if isinstance(noted, list) else []), *extract_entries(public, certificate)]:
            try:
                self.membership_list.add(packed, self._wall())
            except (RemoteError, Full):
                continue

    def _load_guest_certificates(self) -> None:
        """Load the stored certificates of guests whose records this node stores."""
        try:
            noted = msgpack.unpackb(self._store.get_note(GUESTS_NOTE) or EMPTY_GUESTS, max_array_len=MAX_GUESTS)
            for owner, certificate in noted:
                self.admission.add_certificate(owner, certificate)
        except Exception:  # damaged file
            self._log.warn("the stored certificates of guests are damaged; they are requested again from other members")

    def _on_new_entry(self, entry: Entry) -> None:
        self._store.set_note(LIST_NOTE, msgpack.packb(self.membership_list.list_packed()))
        if isinstance(entry, Revocation):
            self._log.info("revoked: {name}", name=entry.name)
            self._store_certificate()
            self._evict_former_members()
            self._evict_revoked(entry.public)
        elif isinstance(entry, Secret):
            found = entry.decrypt(self.identity)
            if found is not None:
                self._adopt_secret(entry, found)
        elif isinstance(entry, Grant):
            self._store_certificate()
            self._evict_former_members()
        elif isinstance(entry, Admission):
            self._log.info("{name} is a member now", name=entry.member.name)
        elif isinstance(entry, Renewal):
            self._store_certificate()
            self._log.info("the certificate of {name} was renewed", name=entry.member.name)

    def _run_periodic(self) -> None:
        self._evict_former_members()
        self._apply_secrets()
        if self._renewer.is_scan_due(self._wall()):
            self._background.fork(self._renew_due())
        newest = next(iter(self.membership_list.list_secrets()), None)
        if newest is not None and newest.number > self.membership.secrets[0][0]:
            self._background.fork(self._request_secret(newest))

    async def _renew_due(self) -> None:
        """Renew some of the members that are due and present."""
        due = [each for each in self._renewer.find_due_members(self._wall()) if self._may_be_reachable(each)]
        for member in self._renewer.pick(due):
            if await self._is_reachable(member):
                self._renewer.renew(member, self._wall())

    def _may_be_reachable(self, member: Member) -> bool:
        """Return whether ``member`` may be reachable; in a large network a node does not know all contacts."""
        assert self._node is not None
        is_me = member.public == self.identity.public
        overlay = self._node.overlay
        return is_me or overlay.is_large or overlay.find_contact(derive_node_id(member.public)) is not None

    async def _is_reachable(self, member: Member) -> bool:
        """Return whether ``member`` is this node, or replies."""
        assert self._node is not None
        if member.public == self.identity.public:
            return True
        overlay, place = self._node.overlay, derive_node_id(member.public)
        contact = overlay.find_contact(place)
        if contact is None:
            found = await overlay.lookup(place)
            contact = next((each for each in found if each.public == member.public), None)
        if contact is None:
            return False
        try:
            await overlay.check(contact)
        except EntangledError:
            return False
        return True

    def _store_certificate(self) -> None:
        """Store the current certificate for the next start."""
        self._store_membership(replace(self.membership, certificate=self.admission.own_pass))

    def _evict_former_members(self) -> None:
        if self._node is not None:
            for public, refusal in self.admission.remove_former_members():
                self._node.evict(public, refusal)
            self._node.recheck()
            self._store_guest_certificates(self._node)

    def _store_guest_certificates(self, node: EntangledNode) -> None:
        """Store the certificates of record owners that are not on the membership list, for the next start."""
        owners = [owner for owner in node.store.owners() if self.admission.is_unlisted(owner)][-MAX_GUESTS:]
        noted = msgpack.packb([[owner, self.admission.find_certificate(owner)] for owner in owners])
        if noted != (self._store.get_note(GUESTS_NOTE) or EMPTY_GUESTS):
            self._store.set_note(GUESTS_NOTE, noted)

    def _evict_revoked(self, public: bytes) -> None:
        """Evict revoked members, including offline members."""
        if self._node is None:
            return
        for each in (public, *self.membership_list.invalidated):
            if self._node.overlay.find_known(derive_node_id(each)) is not None:
                self._node.evict(each, REVOKED)

    def _adopt_secret(self, entry: Secret, secret: bytes) -> None:
        self._log.info("the team has a new secret, number {number}", number=entry.number)
        self._store_membership(self.membership.with_secret(entry.number, secret, entry.at + entry.grace))
        self._apply_secrets()

    def _apply_secrets(self) -> None:
        accepted = [secret for _, secret, _ in self.membership.list_accepted_secrets(self._wall())]
        if accepted != self._accepted_secrets and self._node is not None:
            self._accepted_secrets = accepted
            self._node.endpoint.replace_secrets(*accepted)

    async def _request_secret(self, entry: Secret) -> None:
        """Request a secret from another member, because it was encrypted before this node joined."""
        assert self._node is not None
        others = self._node.overlay.contacts()
        if others:
            found = await self._node.endpoint.ask(self._rng.choice(others), "roll.secret", entry.number)
            if isinstance(found, bytes) and entry.matches(found):
                self._adopt_secret(entry, found)

    def _answer_secret(self, peer: Contact, number: int) -> bytes | None:
        """Return the secret to a current member or guest; None to others."""
        if not self.admission.roles_of(peer.public):
            return None
        return next((secret for known, secret, _ in self.membership.secrets if known == number), None)

    def _build_reply(self, certificate: bytes) -> JoinReply:
        membership = self.membership
        assert self._node is not None
        contacts = [contact for contact in self._node.overlay.contacts() if not contact.address.host.startswith("~")]
        picked = self._rng.sample(contacts, min(len(contacts), join_codec.MAX_CONTACTS))
        secrets = tuple(membership.list_accepted_secrets(self._wall()))
        return JoinReply(certificate, secrets, tuple(picked))

    def _store_membership(self, membership: Membership) -> None:
        try:
            self._membership_store.save(membership)
        except BadKeyFile as error:
            self._log.error("the changed membership could not be stored for the next start: {error}", error=error)
            self._membership_store.membership = membership
