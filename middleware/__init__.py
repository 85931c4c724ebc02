"""The node: peers, records, devices, tasks, and consensus on the agent of each task.  It has no code for robots.

``entangled`` is the peer-to-peer library, and ``node`` connects the packages that use it.
"""
