"""The node: peers, records, devices, tasks, and consensus on who does them.  It knows no robot.

``entangled`` is the peer-to-peer library, and ``node`` wires the packages that stand on it.
"""
