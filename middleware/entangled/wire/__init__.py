"""The sealed wire: handshakes, sessions, messages, and the endpoint that asks and answers over them."""
