"""Quorum: Paxos with leases, the one implementation; ``docs/explanation/quorum.md`` is its specification."""
