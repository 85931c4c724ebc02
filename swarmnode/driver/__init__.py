"""``swarm driver``: find a robot and try it in a terminal, before it joins a team."""
