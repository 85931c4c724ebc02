"""The acceptor of task leases, and the agents that it notifies of the end of a lease."""

from __future__ import annotations

from middleware.consensus.lease.lease_codec import AHEAD, CODEC
from middleware.entangled.data.store import Store
from middleware.entangled.quorum.acceptor import Acceptor, Terms
from middleware.entangled.quorum.ballot import FIRST, Ballot
from middleware.entangled.quorum.log import Log
from middleware.entangled.quorum.register import Kind, Register, Reply

MAX_LISTENERS = 16
ENDED_AGE, IDLE_AGE = 600.0, 86_400.0
"""Seconds after which an unused register may be removed: of a task that has ended, and of any other."""


class LeaseAcceptor(Acceptor[str]):
    """The acceptor of one node, with its votes in ``store``.

    It does not check that a task exists: a lease on an unknown task is harmless and expires.
    """

    def __init__(self, store: Store, born_at: float) -> None:
        log = Log(store, CODEC, may_forget, born_at)
        log.is_whole = log.is_whole and store.origin != "replaced"
        super().__init__(log, Terms(AHEAD), born_at)

    def prepare(
        self, key: str, configuration: int, ballot: Ballot, ttl: float, now: float, reserve: float = 0.0
    ) -> Reply:
        """Promise as any acceptor; if a lease prevents the promise, notify the agent when the lease is released."""
        reply = super().prepare(key, configuration, ballot, ttl, now, reserve)
        register = self.log.get(key)
        if reply.remaining > 0.0 and register is not None and register.until > now and not register.is_given_back:
            register.listeners.pop(ballot.proposer, None)
            if len(register.listeners) >= MAX_LISTENERS:
                del register.listeners[next(iter(register.listeners))]
            register.listeners[ballot.proposer] = now + ttl
        return reply

    def free(self, key: str, ballot: Ballot, now: float, rest: float = 0.0) -> list[str]:
        """Release the promises and leases under ``ballot``; returns the agents to notify."""
        register = self.log.get(key)
        released = self.release(key, ballot, now, rest).kind is Kind.GRANTED
        if not released or register is None or (register.until > now and not register.is_given_back):
            return []
        listeners, register.listeners = register.listeners, {}
        return [agent for agent, until in listeners.items() if until > now and agent != ballot.proposer]

    def freed(self, key: str, agent: str, token: int, now: float, rest: float = 0.0) -> list[str]:
        """Release the lease with this ``agent`` and token, after the holder notified this node as a standby.

        See ``free``.
        """
        register = self.log.get(key)
        if register is None or (register.holder.proposer, register.token) != (agent, token):
            return []
        return self.free(key, register.holder, now, rest)


def may_forget(task_id: str, register: Register, now: float) -> bool:
    """Return whether a register may be removed safely: its lease expired long ago, or its task has ended."""
    age = ENDED_AGE if register.is_over else IDLE_AGE
    # C3: while the task is open, an old configuration must not become valid again.
    return max(register.until, register.touched_at) + age <= now and (
        register.configuration == FIRST or register.is_over
    )
