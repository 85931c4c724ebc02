"""Fault injection: make a node, its process, its network or its robot fail, and measure the time of the takeover.

``kinds``: the faults of a running node with their bounds.  ``network``, ``stream`` and ``process``: faults of
datagrams, of a robot's link, and of the operating system process.  ``injector``: the active faults of one node.
``takeover``: the time until another device continues a task.  ``scenario`` and ``scenario_runner``: faults in a fixed
order from a file.
"""
