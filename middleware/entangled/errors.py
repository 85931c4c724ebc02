"""Exceptions of the peer-to-peer library; the class determines the reaction of the caller.

::

    EntangledError
      RemoteError     the peer violated the protocol: count and drop
        Malformed
        Forged
      TransientError the network or a peer is unavailable: retry with backoff NoAnswer NotAcknowledged Crowded
      Unavailable LocalError the caller made an error: propagate NotRunning TooLarge PortInUse TunnelPortInUse BadStore
      Refused the peer answered, and rejected the request Full Unwritable Conflict NotAdmitted
"""

_WAIT = "try again when members have returned, or in two minutes, when absent members are no longer counted"


class EntangledError(Exception):
    """The base class of all exceptions of the library."""


class RemoteError(EntangledError):
    """A peer sent invalid data."""


class Malformed(RemoteError):
    """The bytes are not a valid message."""


class Forged(RemoteError):
    """The bytes or the record are not authentic."""


class TransientError(EntangledError):
    """The network did not deliver in time; a retry may succeed."""


class NoAnswer(TransientError):
    """The peer did not answer any of the tries."""


class NotAcknowledged(NoAnswer):
    """Fewer replicas stored a write than its consistency level requires; they may still send it to other replicas.

    ``acknowledged`` replicas confirmed the write, ``needed`` confirmations were required.
    """

    def __init__(self, acknowledged: int, needed: int) -> None:
        super().__init__(
            f"only {acknowledged} of {needed} needed replicas acknowledged the record; {_WAIT}, or write with 'one'"
        )
        self.acknowledged = acknowledged
        self.needed = needed


class Unavailable(TransientError):
    """Too few replicas answered a read, so the content of the key is unknown.

    ``answered`` replicas gave a valid answer, ``needed`` were required.
    """

    def __init__(self, answered: int, needed: int) -> None:
        super().__init__(f"only {answered} of {needed} needed replicas answered; {_WAIT}, or read with 'fast'")
        self.answered = answered
        self.needed = needed


class Crowded(TransientError):
    """This node has reached a limit of pending messages; nothing was sent, and the state of the peer is unknown."""


class LocalError(EntangledError):
    """The caller made an error."""


class NotRunning(LocalError):
    """The node has not started, or has stopped."""


class TooLarge(LocalError):
    """A name, value or message exceeds the limit of the network; split or shorten it."""


class PortInUse(LocalError):
    """Another program uses the port, or this machine does not have the address; the message contains the remedy."""


class TunnelPortInUse(PortInUse):
    """The TCP port of tunnels is in use, or is below 1024 and the node may not open it."""


class BadStore(LocalError):
    """The data store is unusable; the message contains the reason and the remedy."""


class Refused(EntangledError):
    """The peer rejected the request; ``str()`` gives the reason as text, ``code`` identifies it for programs."""

    code = "refused"

    def __init__(self, text: str = "", code: str | None = None) -> None:
        super().__init__(text)
        if code is not None:
            self.code = code


OWNER_FULL = "owner-full"
"""The code of ``Full`` if the store has free space, but not for more records of this owner."""


class Full(Refused):
    """The store is full and may delete nothing; remove records, or raise its limits of rows or bytes.

    With the code ``OWNER_FULL``, the owner of the record has reached the limit per owner.
    """


class Unwritable(Refused):
    """The store's file is not writable (full disk, read-only, corrupt); reads continue, writes resume when it is."""


class Conflict(Refused):
    """A compare-and-set failed: the slot has the sequence number ``sequence`` instead of ``expected``."""

    def __init__(self, expected: int, sequence: int) -> None:
        super().__init__(f"the slot has the number {sequence}, not the expected {expected}; read it again and retry")
        self.expected = expected
        self.sequence = sequence


class NotAdmitted(Refused):
    """One of two nodes rejects the other: ``code`` is the reason; the text identifies both nodes and gives a remedy."""

    def __init__(self, text: str, code: str) -> None:
        super().__init__(text, code)
