"""Answers about a running node: its store, contacts and links, and why a device was chosen for a task."""
