"""How bids for one task reach its council, and how the announcement comes back: ``direct``, ``tree``, ``flood``.

``auctions`` runs on a node's endpoint; everything else here is pure.
"""
