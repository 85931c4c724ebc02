"""Every exception of this room; the class says who is to blame, and so what to do.

::

    DriverError
      RobotError      the robot's fault: count it, drop the frame, live on
        BadFrame
      LinkError       nobody's fault: stop the motion, reconnect
        LinkLost
        NoReply
      UsageError      the caller's fault: let it fly
        NotEnabled
        Unsupported
        StaleCommand
"""


class DriverError(Exception):
    """The root of what a driver raises."""


class RobotError(DriverError):
    """The robot said something that it should not have said."""


class BadFrame(RobotError):
    """Bytes from the robot are not a frame; they are dropped and counted."""


class LinkError(DriverError):
    """The way to the robot does not work at the moment."""


class LinkLost(LinkError):
    """The link to the robot went away; the driver tries to open it again."""


class NoReply(LinkError):
    """The robot did not answer in time."""


class UsageError(DriverError):
    """The driver was asked for something that cannot be."""


class NotEnabled(UsageError):
    """A motion was asked for while the robot is not ready or its motors are off; call ``enable()`` first."""


class Unsupported(UsageError):
    """This robot has no such capability, key or skill; look at ``description``."""


class StaleCommand(UsageError):
    """A command carries a token older than one already seen, or its deadline has passed; it was not sent."""
