"""The DHT overlay: the XOR metric, routing table, lookups and membership (Maymounkov and Mazieres, 2002)."""
