"""Paxos with leases; ``docs/explanation/quorum.md`` is its specification."""
