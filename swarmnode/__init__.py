"""The front door: settings in, a running node out; the ``swarm`` command; a rehearsal of a whole team in memory."""
