"""The data store: what a node holds, in memory or in a SQLite file."""
