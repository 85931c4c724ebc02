"""The node: peers, records, who is here, what is to be done, and who does it.  It knows no robot.

``entangled`` is the peer-to-peer library; ``presence``, ``tasks``, ``consensus`` and ``streams`` stand on it;
``node`` wires them.
"""
