"""Tests with real sockets, processes and browsers."""

import signal

# A background job inherits an ignored SIGINT, and so would the child processes to which these tests send one.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
