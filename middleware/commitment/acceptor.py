"""Acceptor: one member of a task's council; it promises, grants, and counts down what it granted.

The moment is an argument.  Safety is that of Paxos: a lease is proposed under a ballot that a majority has promised,
after none of them had another's lease in force; two majorities share a member (PaxosLease, arXiv 1209.4187).
"""

from __future__ import annotations

import math

from middleware.commitment.ballot import (
    AHEAD,
    BEHIND,
    FIRST,
    GRANTED,
    HELD,
    MOVED,
    NONE,
    OUTBID,
    OVER,
    QUIET,
    SEALED,
    Ballot,
    Ceiling,
    Reply,
)
from middleware.commitment.ledger import Entry, Ledger
from middleware.entangled.kademlia.contact import Contact

MAX_LISTENERS = 16
ROOM = 1.0
"""Seconds after which a claimant may ask again where there was no room for its task."""


class Acceptor:
    """A council member since ``born_at``.

    It does not know whether a task exists: a lease on nothing hurts nobody and runs out.  What its ``ledger`` may have
    forgotten it keeps silent about for the longest ttl.
    """

    def __init__(self, ledger: Ledger, born_at: float = -math.inf) -> None:
        self._ledger = ledger
        self._born_at = born_at

    def prepare(self, task_id: str, configuration: int, ballot: Ballot, ttl: float, now: float) -> Reply:
        """Promise to accept nothing under a lower ballot, or say what stands against it.

        While another holds the lease (a former life of the same agent is another) nothing changes but that the asker
        is told when it is given back.  Once it is given back, or about to run out, a promise tells how long nothing is
        granted yet; it stands against no renewal.  A ballot of counter 0 only looks, and is promised nothing: a member
        whose grant has run out, because it missed a renewal, is not to be lost to its healthy holder.
        """
        entry = self._entry(task_id, configuration, ttl, now)
        if isinstance(entry, Reply):
            return entry
        is_kin = entry.ballot.is_kin(ballot)
        if entry.until > now and not (is_kin or entry.is_given_back):
            self._listen(entry, ballot.agent, now + ttl)
            if ballot.counter == 0 or entry.until - now > AHEAD * entry.ttl:
                return self._reply(HELD, entry, now)
        if ballot.counter > 0 and (ballot < entry.promised or not entry.ceiling.admits(now, ballot.counter)):
            return self._reply(OUTBID, entry, now)
        entry.touched_at = now
        if ballot > entry.promised:
            entry.promised = ballot
            self._ledger.keep(task_id)
        if entry.sealed != NONE:
            return self._reply(SEALED, entry, now)._replace(ballot=entry.sealed)
        reply = self._reply(GRANTED, entry, now)
        return reply._replace(remaining=0.0) if is_kin else reply

    def propose(self, task_id: str, configuration: int, ballot: Ballot, token: int, ttl: float, now: float) -> Reply:
        """Grant the lease for ``ttl`` seconds from now, or renew it, unless a higher ballot or token was seen."""
        entry = self._entry(task_id, configuration, ttl, now)
        if isinstance(entry, Reply):
            return entry
        if entry.sealed != NONE:
            return self._reply(SEALED, entry, now)._replace(ballot=entry.sealed)
        is_lower = token < entry.token or (token == entry.token and not ballot.is_kin(entry.ballot))
        is_held = entry.until > now
        # What was promised to another for the time after a lease does not end it: who holds it renews it all the same.
        is_own = entry.ballot.is_kin(ballot)
        is_renewal = is_held and is_own and token == entry.token and not entry.is_given_back
        is_bounded = entry.ceiling.admits(now, ballot.counter, token)
        if (ballot < entry.promised and not is_renewal) or ballot <= entry.spent or is_lower or not is_bounded:
            return self._reply(OUTBID, entry, now)
        if is_held and not is_own:
            return self._reply(HELD, entry, now)
        promised = max(entry.promised, ballot)
        is_new = (entry.promised, entry.ballot, entry.token, entry.ttl) != (promised, ballot, token, ttl)
        entry.promised, entry.ballot = promised, ballot
        entry.token, entry.grantee, entry.ttl = token, ballot.agent, ttl
        entry.until, entry.touched_at = now + ttl, now
        if is_new:
            self._ledger.keep(task_id)
        return self._reply(GRANTED, entry, now)

    def release(self, task_id: str, ballot: Ballot, now: float, rest: float = 0.0) -> list[str]:
        """End what was granted under ``ballot`` or an older one of that life, for good, and name who is to be told.

        ``rest`` is how long the robot may still move: until then others are promised the lease, but not granted.
        """
        entry = self._ledger.get(task_id)
        if entry is None or ballot <= entry.spent:
            return []
        is_own = entry.ballot.is_kin(ballot)
        if not (is_own or entry.promised.is_kin(ballot)):
            return []
        # A proposal of that ballot may still be on its way: it comes too late.
        if entry.until > now and not (is_own or entry.is_given_back):
            # It was promised for the time after another's lease, which goes on.
            entry.promised = max(entry.promised, Ballot(ballot.counter + 1, ""))
            self._ledger.keep(task_id)
            return []
        entry.spent = ballot
        if is_own and entry.ballot <= ballot:
            entry.until = min(entry.until, now + rest)
            entry.ballot = entry.ballot if entry.until > now else NONE
        self._ledger.keep(task_id)
        if entry.until > now and not entry.is_given_back:
            return []
        listeners, entry.listeners = entry.listeners, {}
        return [agent for agent, until in listeners.items() if until > now and agent != ballot.agent]

    def freed(self, task_id: str, agent: str, token: int, now: float, rest: float = 0.0) -> list[str]:
        """End the lease of that ``agent`` and token: it said so to a stand-by that is a member, too (``release``)."""
        entry = self._ledger.get(task_id)
        is_its = entry is not None and entry.ballot.agent == agent and entry.token == token
        return self.release(task_id, entry.ballot, now, rest) if entry is not None and is_its else []

    def close(self, task_id: str, agent: str, configuration: int, token: int, now: float) -> Reply:
        """Grant no more leases on a task that has ended; ``remaining`` is how long another may still act on it.

        An agent names the token that it was granted here, even if it has given the lease back since; any other one is
        refused.  Token 0 is an operator's.
        Where the council is another one by now, or may be, that one has to be asked as well.
        """
        entry = self._ledger.get(task_id) or self._ledger.add(task_id, FIRST, now)
        if entry is None:
            return Reply(QUIET, remaining=ROOM)
        if token and (entry.token, entry.grantee) != (token, agent):
            return self._reply(OUTBID if token < entry.token else BEHIND, entry, now)
        if not entry.is_over:
            entry.is_over, entry.touched_at = True, now
            self._ledger.keep(task_id)
        has_moved = configuration < entry.configuration
        reply = self._reply(MOVED if has_moved else OVER if entry.sealed == NONE else SEALED, entry, now)
        is_done = entry.ballot.agent == agent and entry.token == token
        return reply._replace(remaining=0.0) if is_done else reply

    def change(
        self,
        task_id: str,
        configuration: int,
        ballot: Ballot,
        members: tuple[Contact, ...],
        token: int,
        now: float,
        keep: bool = False,
    ) -> Reply:
        """Accept ``members`` as the next council, unless a lease is open: from then on no lease of the present one.

        With ``keep`` an agent says that its own lease is given back (its robot stands still), and kept for it so long.
        """
        entry = self._entry(task_id, configuration, 0.0, now)
        if isinstance(entry, Reply):
            return entry
        if entry.until > now and not (keep and entry.ballot.is_kin(ballot)):
            return self._reply(HELD, entry, now)
        if ballot < entry.promised or ballot <= entry.spent or not entry.ceiling.admits(now, ballot.counter, token):
            return self._reply(OUTBID, entry, now)
        entry.promised = entry.sealed = ballot
        entry.members, entry.touched_at = members, now
        entry.hear_token(token)
        self._ledger.keep(task_id)
        return self._reply(GRANTED, entry, now)

    def install(
        self,
        task_id: str,
        configuration: int,
        members: tuple[Contact, ...],
        token: int,
        now: float,
        ballot: Ballot = NONE,
        ttl: float = 0.0,
        charter: bytes = b"",
    ) -> Reply:
        """Learn that a majority of the council before has chosen ``members``, and above which token they go on.

        The caller has checked that: ``charter`` proves it to those who ask here later.  Nobody but the agent of
        ``ballot`` is granted the lease for ``ttl`` seconds.
        """
        entry = self._ledger.get(task_id) or self._ledger.add(task_id, FIRST, now)
        if entry is None:
            return Reply(QUIET, remaining=ROOM)
        if configuration > entry.configuration:
            entry.configuration, entry.members, entry.sealed = configuration, members, NONE
            entry.ballot, entry.until = ballot, now if ballot == NONE else now + ttl
            entry.touched_at, entry.charter = now, charter
            entry.hear_token(token, ballot.agent)
            entry.ceiling = Ceiling(now, entry.promised, entry.token)
            self._ledger.keep(task_id)
        return self._reply(GRANTED if configuration == entry.configuration else MOVED, entry, now)

    # -- inside -----------------------------------------------------------------------------------------------------

    def _entry(self, task_id: str, configuration: int, ttl: float, now: float) -> Entry | Reply:
        """The entry of a task, or what stands against whatever is asked."""
        quiet = self._silence(ttl) - now
        if quiet > 0.0:
            return Reply(QUIET, remaining=quiet)
        entry = self._ledger.get(task_id)
        if entry is None and configuration == FIRST:
            entry = self._ledger.add(task_id, configuration, now)
            if entry is None:
                return Reply(QUIET, remaining=ROOM)
        if entry is None or configuration > entry.configuration:
            return Reply(BEHIND, configuration=0 if entry is None else entry.configuration)
        if entry.is_over:
            return self._reply(OVER, entry, now)
        if configuration < entry.configuration:
            return self._reply(MOVED, entry, now)
        return entry

    def _silence(self, ttl: float) -> float:
        """Until when it grants nothing, because it may have granted something that it has forgotten."""
        return -math.inf if self._ledger.is_whole else self._born_at + max(ttl, self._ledger.longest)

    def _listen(self, entry: Entry, agent: str, until: float) -> None:
        entry.listeners.pop(agent, None)
        if len(entry.listeners) >= MAX_LISTENERS:
            del entry.listeners[next(iter(entry.listeners))]
        entry.listeners[agent] = until

    def _reply(self, kind: str, entry: Entry, now: float) -> Reply:
        members = entry.members if kind == SEALED else ()
        remaining = max(0.0, entry.until - now)
        proof = entry.charter if kind == MOVED else b""
        return Reply(kind, entry.promised, entry.token, remaining, entry.configuration, members, proof)
