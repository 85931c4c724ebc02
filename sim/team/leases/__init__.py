"""Simulated agents, acceptors and devices of task leases, without the rest of a node: a thousand schedules in a minute.

``team``: the places, and what lies between them.  ``bidder``: one life of a place.  ``radio``: the messages.
``referee``: writes down who holds, commands and moves.  ``takeover``: trials of how soon a stand-by holds a lease.
"""
