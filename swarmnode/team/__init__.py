"""The verbs of ``swarm`` for closed teams: create a team, invite, join, list, renew and revoke members."""
