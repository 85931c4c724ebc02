"""The data store of a node, in memory or in a SQLite file."""
