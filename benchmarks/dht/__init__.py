"""Compare the peer-to-peer library with other DHT libraries in one run: ``python -m benchmarks.dht``."""
