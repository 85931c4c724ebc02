"""Access to the team for user interfaces: a view of its records, and a client for requests and orders."""
