"""Tests of the paths between nodes through NAT routers."""
