"""Bids of agents for a task, and their announcement by the task's quorum members.

Bids are sent to the quorum members directly (``bid_delivery``) or through other nodes (``tree``). If no quorum member
is reachable, bids can be flooded (``flood``). A quorum member then announces the best bids (``announcer``). Only
``auction_service`` and ``group`` use the network; all other modules are pure.
"""
