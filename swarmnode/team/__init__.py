"""Team: the operator's side of a closed team, and a newcomer's: the verbs of ``swarm`` that make, open and close it."""
