"""Every exception of the peer-to-peer library; the class says who is to blame, and so what to do.

::

    EntangledError
      RemoteError     the peer's fault: count it, drop it, live on
        Malformed
        Forged
      WeatherError    nobody's fault: try again, with back-off
        NoAnswer
          NotAcknowledged
        Crowded
        Unavailable
      LocalError      our caller's fault: let it fly
        NotRunning
        TooLarge
        PortInUse
          TunnelPortInUse
        BadStore
      Refused         a lawful no: an answer, and no accident
        Full
        Unwritable
        Conflict
        NotAdmitted
"""

_WAIT = "try again when members are back, or in two minutes, when the absent count no more"


class EntangledError(Exception):
    """The root of what the library raises."""


class RemoteError(EntangledError):
    """A peer sent what it should not have sent."""


class Malformed(RemoteError):
    """Bytes that are not a message."""


class Forged(RemoteError):
    """Bytes or a record that do not come from where they claim."""


class WeatherError(EntangledError):
    """The network did not carry it this time."""


class NoAnswer(WeatherError):
    """The peer did not answer any of the tries."""


class NotAcknowledged(NoAnswer):
    """A write did not get as many replicas as its concern wants; those that have it keep it, and it may still spread.

    ``acknowledged`` replicas said that they have it, ``needed`` were wanted.
    """

    def __init__(self, acknowledged: int, needed: int) -> None:
        super().__init__(
            f"{acknowledged} replicas acknowledge the record, {needed} are needed; {_WAIT}, or write with 'one'"
        )
        self.acknowledged = acknowledged
        self.needed = needed


class Unavailable(WeatherError):
    """Too few replicas answered to say what a key holds; it may hold something.

    ``answered`` replicas gave an answer that counts, ``needed`` were wanted.
    """

    def __init__(self, answered: int, needed: int) -> None:
        super().__init__(f"{answered} replicas of the key answer, {needed} are needed; {_WAIT}, or read 'fast'")
        self.answered = answered
        self.needed = needed


class Crowded(WeatherError):
    """This node has as much on its way as it may; nothing was sent, and nothing is said about the peer."""


class LocalError(EntangledError):
    """The caller asked for something that cannot be."""


class NotRunning(LocalError):
    """The node was asked before it started or after it stopped."""


class TooLarge(LocalError):
    """A name, value or message is larger than what the network carries; split it, or shorten it."""


class PortInUse(LocalError):
    """Another program holds the port, or the address is not one of this machine; the message says what to change."""


class TunnelPortInUse(PortInUse):
    """The same of the TCP port for tunnels, or the node may not open one below 1024."""


class BadStore(LocalError):
    """The data store cannot be used as it is; the message says why and what to do."""


class Refused(EntangledError):
    """The peer understood and said no; ``str()`` is its reason, ``code`` names the kind of it for programs."""

    code = "refused"

    def __init__(self, text: str = "", code: str | None = None) -> None:
        super().__init__(text)
        if code is not None:
            self.code = code


OWNER_FULL = "owner-full"
"""The code of ``Full`` where the store has room, though not for more of this owner."""


class Full(Refused):
    """The store has no room and nothing that it may let go of; remove some, or allow it more rows or bytes.

    With the code ``OWNER_FULL`` it is the owner of the record that has all that one owner may have.
    """


class Unwritable(Refused):
    """The store's file cannot be written now (full disk, read-only, broken); reads go on, writes do when it can."""


class Conflict(Refused):
    """A compare-and-set came too late: the slot holds ``sequence`` already."""

    def __init__(self, expected: int, sequence: int) -> None:
        super().__init__(f"the slot holds number {sequence}, expected was {expected}; read it and decide again")
        self.expected = expected
        self.sequence = sequence


class NotAdmitted(Refused):
    """One of two nodes does not let the other in: ``code`` names why, the text says who refuses whom and what to do."""

    def __init__(self, text: str, code: str) -> None:
        super().__init__(text, code)
