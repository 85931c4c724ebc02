"""Tests with real sockets, processes and browsers."""

import signal

# A background job inherits an ignored SIGINT. Child processes, to which these tests send SIGINT, would inherit it too.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
