"""Tasks, the orders about them, and the councils of nodes that grant their leases."""
