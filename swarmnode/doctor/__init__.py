"""Doctor: what keeps a node from its team, judged from what was measured."""
