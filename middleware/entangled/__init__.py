"""The peer-to-peer library: Kademlia, owned records, watch and RPC over sealed datagrams, with a data store.

It stands alone: it knows nothing of devices, tasks or robots.  It is the successor, for Python 3, of the library of
that name which the thesis uses (section 4.3.1).  ``node.EntangledNode`` is the door.
"""
