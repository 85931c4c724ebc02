"""The wire protocol: handshakes, encrypted sessions, messages, and the endpoint that sends and answers requests."""
