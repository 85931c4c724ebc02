"""Tasks, operators' orders about them, and the quorum members that grant their leases."""
