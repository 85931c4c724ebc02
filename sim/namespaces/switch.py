"""Switch the frames of the wide area between the sites in one process, with link impairments.

``python -m sim.namespaces.switch SEED NAME=INTERFACE ..`` connects these interfaces of its namespace by raw sockets, so
the kernel needs no traffic control.  Orders arrive as JSON lines, and each is echoed when it is in force; the process
ends with its input.  A frame passes three lines: out of its site, between the two sites, and into the other site.
"""

from __future__ import annotations

import heapq
import json
import os
import select
import socket
import struct
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from random import Random
from typing import Any, BinaryIO

from sim.namespaces.line import Line, Weather

EVERYTHING = 3
PACKET, IGNORE_OUTGOING = 263, 23
ADDRESSES = 14
"""Length of an Ethernet header in bytes: two addresses and a type."""
IP_HEADERS = ADDRESSES + 20
ARP = b"\x08\x06"
BUFFER = 4 << 20
AT_ONCE = 64
SNAP = 65535
FILE_HEADER = struct.pack("=IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, SNAP, 1)
"""The classic pcap format: magic, version 2.4, no time zone, whole frames, Ethernet."""


class Port:
    """One interface of a site, with a line for each direction."""

    def __init__(self, name: str, interface: str, rng: Random) -> None:
        self.name = name
        self.socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(EVERYTHING))
        self.socket.setsockopt(PACKET, IGNORE_OUTGOING, 1)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)
        self.socket.bind((interface, 0))
        self.socket.setblocking(False)
        self.up, self.down = Line(rng), Line(rng)

    def frames(self) -> Iterator[bytes]:
        """Yield received frames, a limited number per call."""
        for _ in range(AT_ONCE):
            try:
                yield self.socket.recv(SNAP)
            except OSError:
                return


class Switch:
    """All ports; a frame goes to the port of its receiver if that is known, else to all."""

    def __init__(self, ports: dict[str, str], rng: Random) -> None:
        self._rng = rng
        self._ports = {name: Port(name, interface, rng) for name, interface in ports.items()}
        self._by_file = {port.socket.fileno(): port for port in self._ports.values()}
        self._pair_lines: defaultdict[tuple[str, str], Line] = defaultdict(lambda: Line(rng))
        self._port_of: dict[bytes, Port] = {}
        self._waiting: list[tuple[float, int, Port, bytes]] = []
        self._number = 0
        self._record: BinaryIO | None = None

    def run(self, orders: int) -> None:
        """Switch frames until the file ``orders`` ends."""
        poll = select.epoll()
        for file in (orders, *self._by_file):
            poll.register(file, select.EPOLLIN)
        rest = b""
        while True:
            wait = -1.0 if not self._waiting else max(0.0, self._waiting[0][0] - time.monotonic())
            for file, _ in poll.poll(wait):
                if file != orders:
                    port = self._by_file[file]
                    for frame in port.frames():
                        self._enter(port, frame)
                    continue
                read = os.read(orders, 65536)
                if not read:
                    return
                *lines, rest = (rest + read).split(b"\n")
                for line in lines:
                    sys.stdout.write(json.dumps(self._execute(json.loads(line))) + "\n")
                    sys.stdout.flush()
            now = time.monotonic()
            while self._waiting and self._waiting[0][0] <= now:
                _, _, port, frame = heapq.heappop(self._waiting)
                self._leave(port, frame)

    def _enter(self, source: Port, frame: bytes) -> None:
        receiver, sender = frame[:6], frame[6:12]
        self._port_of[sender] = source
        target = None if receiver[0] & 1 else self._port_of.get(receiver)
        targets = [target] if target is not None else [port for port in self._ports.values() if port is not source]
        if self._record is not None:
            self._record.write(recorded(frame))
        now = time.monotonic()
        for port in targets:
            if port is not source:
                pair_line = self._pair_lines.get((source.name, port.name))
                self._carry([source.up, *([pair_line] if pair_line is not None else []), port.down], port, frame, now)

    def _carry(self, lines: list[Line], port: Port, frame: bytes, now: float) -> None:
        if frame[12:14] == ARP:
            # ARP is exempt unless the line is cut: real long-distance lines have none, and a retry takes a second.
            if not any(line.weather.loss == 100.0 for line in lines):
                self._leave(port, frame)
            return
        moments = [now]
        for line in lines:
            moments = [later for moment in moments for later in line.fates(len(frame), moment)]
            frame = line.spoiled(frame, IP_HEADERS)
        for moment in moments:
            if moment <= now:
                self._leave(port, frame)
            else:
                self._number += 1
                heapq.heappush(self._waiting, (moment, self._number, port, frame))

    def _leave(self, port: Port, frame: bytes) -> None:
        try:
            port.socket.send(frame)
        except OSError:
            port.down.lost += 1

    def _execute(self, order: dict[str, Any]) -> object:
        match order["do"]:
            case "weather":
                self._line(order).weather = Weather(**order["weather"])
            case "count":
                return {name: {"up": port.up.counts, "down": port.down.counts} for name, port in self._ports.items()}
            case "record":
                self._record_to(order["file"])
        return order

    def _line(self, order: dict[str, Any]) -> Line:
        if order["to"]:
            return self._pair_lines[order["port"], order["to"]]
        port = self._ports[order["port"]]
        return port.up if order["is_up"] else port.down

    def _record_to(self, path: str) -> None:
        if self._record is not None:
            self._record.close()
        self._record = None
        if path:
            self._record = open(path, "wb")  # noqa: SIM115 - open until the order to close it
            self._record.write(FILE_HEADER)


def recorded(frame: bytes) -> bytes:
    """Return a frame as a pcap record with the present time."""
    now = time.time()
    return struct.pack("=IIII", int(now), int(now % 1 * 1_000_000), len(frame), len(frame)) + frame


def main(seed: str, *ports: str) -> None:
    """Run the switch until standard input ends."""
    pairs = (port.partition("=")[::2] for port in ports)
    switch = Switch(dict(pairs), Random(seed))
    sys.stdout.write('"ready"\n')
    sys.stdout.flush()
    switch.run(0)


if __name__ == "__main__":
    main(*sys.argv[1:])
