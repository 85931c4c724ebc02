"""The devices of the team: the presence record of each, and the list of all, split by prefix in a large team."""
