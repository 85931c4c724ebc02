"""Kademlia: the distance of ids, whom a node knows, and how it finds others (Maymounkov and Mazieres, 2002)."""
