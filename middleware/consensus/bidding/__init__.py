"""Bidding.

Bids for a task travel to its quorum members (``direct``, ``tree`` or ``flood``) and an announcement returns.
``auctions`` uses a node's endpoint; all other modules are pure.
"""
