"""Emulator of the rover, on an unlimited floor; ``python emulator.py`` serves the emulator on port 4000."""

import math

PERIOD_S = 0.05


class Emulator:
    """One rover, timed by ``clock``; it executes the latest command of any client."""

    def __init__(self, clock):
        self._clock = clock
        self._links = []
        self._started_at = clock.seconds()
        self._x = self._y = self._yaw = self._vx = self._wz = 0.0
        self._has_motors = False
        self._report()

    def accept(self, link):
        """Add ``link`` to the clients; return the object that receives its data."""
        self._links.append(link)
        return _Client(self, link)

    def true_speed(self):
        """Return the speed of the rover in m/s."""
        return abs(self._vx)

    def obey(self, line):
        """Execute a command; ignore unknown lines."""
        command, *numbers = line.split() or [b""]
        if command == b"M":
            self._has_motors = numbers == [b"1"]
            self._vx = self._wz = 0.0
        elif command == b"V" and self._has_motors:
            self._vx, self._wz = map(float, numbers)

    def leave(self, link):
        """Remove ``link`` from the clients, and stop the rover."""
        self._links.remove(link)
        self._vx = self._wz = 0.0

    def _report(self):
        self._clock.callLater(PERIOD_S, self._report)
        self._x += self._vx * math.cos(self._yaw) * PERIOD_S
        self._y += self._vx * math.sin(self._yaw) * PERIOD_S
        self._yaw = math.remainder(self._yaw + self._wz * PERIOD_S, math.tau)
        t = self._clock.seconds() - self._started_at
        line = f"{t:.3f} {self._x:.4f} {self._y:.4f} {self._yaw:.4f} 0 {self._has_motors:d}\n"
        for link in self._links:
            link.send(line.encode())


class _Client:
    def __init__(self, rover, link):
        self._rover, self._link, self._rest = rover, link, b""

    def data_received(self, data):
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            self._rover.obey(line)

    def link_down(self):
        self._rover.leave(self._link)


if __name__ == "__main__":
    from twisted.internet import reactor

    from drivers.link import TcpLinkFactory

    reactor.listenTCP(4000, TcpLinkFactory(Emulator(reactor).accept), interface="127.0.0.1")
    print("serving a rover on 127.0.0.1:4000; press Ctrl-C to stop")
    reactor.run()
