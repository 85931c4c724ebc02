"""The team as a user interface needs it: a view of its records, and a client that calls and orders."""
