"""How bids for one task reach those who decide, and how what was decided comes back: ``direct``, ``tree``, ``flood``.

``dissemination`` is the shell on a node's endpoint; everything else here is pure.
"""
