"""The node as a service of systemd: the unit, and the verb that installs it."""
