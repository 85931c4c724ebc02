"""Quorum: Paxos with leases, the one implementation; ``docs/quorum.md`` is its specification."""
