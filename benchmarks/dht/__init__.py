"""The peer-to-peer library beside others of its kind, measured in one run: ``python -m benchmarks.dht``."""
