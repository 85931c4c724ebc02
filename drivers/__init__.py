"""The robots: SI units in and out.

``driver`` is the contract, ``reading`` what goes through it, ``errors`` what goes wrong,
``registry`` finds the driver of a kind.  One folder a robot below.  This room knows no network of peers.
"""
