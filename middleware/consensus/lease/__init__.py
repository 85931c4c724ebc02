"""Task leases: a majority of a task's council grants one lease at a time, with an increasing fencing token."""
