"""Consensus: strategies choose the agent that should act; a quorum lease gives an agent the right to act.

``strategy`` is the interface of strategies, and ``strategies`` contains the built-in strategies.  ``bidding`` sends
reports to the quorum members of a task, and the announcement of a quorum member to the agents.  ``lease`` grants the
right to act.
"""
