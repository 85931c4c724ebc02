"""``swarm driver``: find a robot and test it in a terminal, before it joins a team."""
