"""The acceptor of task leases, which also lists the agents to notify when a lease is released."""

from __future__ import annotations

from middleware.consensus.lease.lease_codec import CODEC, EARLY_PROMISE_SHARE
from middleware.entangled.data.store import Store
from middleware.entangled.quorum.acceptor import Acceptor, AcceptorSettings
from middleware.entangled.quorum.acceptor_log import RegisterLog
from middleware.entangled.quorum.ballot import FIRST_CONFIGURATION, Ballot
from middleware.entangled.quorum.register import Register, Reply, ReplyKind

MAX_LISTENERS = 16
ENDED_AGE_S, IDLE_AGE_S = 600.0, 86_400.0
"""Seconds after its last change from which a register may be evicted: for an ended task, and for a task that has not
ended."""


class LeaseAcceptor(Acceptor[str]):
    """The acceptor of one node, which writes its registers to ``store``.

    The acceptor does not check whether a task exists, because a lease for an unknown task is harmless and expires.
    """

    def __init__(self, store: Store, born_at: float) -> None:
        log = RegisterLog(store, CODEC, may_evict, born_at)
        log.is_complete = log.is_complete and store.origin != "replaced"
        super().__init__(log, AcceptorSettings(EARLY_PROMISE_SHARE), born_at)

    def prepare(
        self, key: str, configuration: int, ballot: Ballot, ttl: float, now: float, reserve: float = 0.0
    ) -> Reply:
        """Promise as ``Acceptor`` does; if a lease blocks the agent, add the agent to the listeners for its release."""
        reply = super().prepare(key, configuration, ballot, ttl, now, reserve)
        register = self.log.get(key)
        if reply.remaining > 0.0 and register is not None and register.lease_until > now and not register.is_released:
            register.listeners.pop(ballot.proposer, None)
            if len(register.listeners) >= MAX_LISTENERS:
                del register.listeners[next(iter(register.listeners))]
            register.listeners[ballot.proposer] = now + ttl
        return reply

    def release_by_ballot(self, key: str, ballot: Ballot, now: float, rest: float = 0.0) -> list[str]:
        """Release promises and leases under ``ballot``; return the agents to notify."""
        register = self.log.get(key)
        released = self.release(key, ballot, now, rest).kind is ReplyKind.GRANTED
        if not released or register is None or (register.lease_until > now and not register.is_released):
            return []
        listeners, register.listeners = register.listeners, {}
        return [agent for agent, until in listeners.items() if until > now and agent != ballot.proposer]

    def release_by_token(self, key: str, agent: str, token: int, now: float, rest: float = 0.0) -> list[str]:
        """Release the lease that ``agent`` holds with ``token``; return the agents to notify."""
        register = self.log.get(key)
        if register is None or (register.holder.proposer, register.token) != (agent, token):
            return []
        return self.release_by_ballot(key, register.holder, now, rest)


def may_evict(task_id: str, register: Register, now: float) -> bool:
    """Return whether a register may be evicted: its task ended, or its lease expired, long ago."""
    age = ENDED_AGE_S if register.is_closed else IDLE_AGE_S
    # If the task is open, an evicted register would make an old configuration valid again.
    return max(register.lease_until, register.touched_at) + age <= now and (
        register.configuration == FIRST_CONFIGURATION or register.is_closed
    )
