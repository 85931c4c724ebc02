"""The peer-to-peer library: Kademlia, owned records, watch and RPC over sealed datagrams, with a data store.

The library is independent of devices, tasks and robots.  It is the successor, for Python 3, of the library of the same
name that the thesis uses (section 4.3.1).  ``node.EntangledNode`` is its public interface.
"""
