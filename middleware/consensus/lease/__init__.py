"""Task leases: a majority of a task's quorum members grants one lease at a time, with increasing fencing tokens."""
