"""Real nodes behind every pair of routers, in network namespaces (``make live-nat``)."""
