"""Exceptions of drivers; the classes distinguish faults of the robot, the connection and the caller.

::

    DriverError
      RobotError      fault of the robot: count it, drop the frame, continue
        BadFrame
      LinkError       fault of the connection: stop the motion, reconnect
        LinkLost
        NoReply
      UsageError      fault of the caller: let it propagate
        NotEnabled
        Unsupported
        StaleCommand
"""


class DriverError(Exception):
    """Base class of the exceptions of drivers."""


class RobotError(DriverError):
    """The robot sent data that violates its protocol."""


class BadFrame(RobotError):
    """Bytes from the robot are not a valid frame; the driver drops and counts them."""


class LinkError(DriverError):
    """The connection to the robot does not work at present."""


class LinkLost(LinkError):
    """The link to the robot was lost; the driver reconnects."""


class NoReply(LinkError):
    """The robot did not answer in time."""


class UsageError(DriverError):
    """The driver was called in a way that it does not allow."""


class NotEnabled(UsageError):
    """A motion was commanded while the robot is not ready or its motors are off; call ``enable()`` first."""


class Unsupported(UsageError):
    """This robot has no such capability, key or skill; see ``description``."""


class StaleCommand(UsageError):
    """A command was not sent: its token is lower than the highest seen, or its deadline has passed."""
