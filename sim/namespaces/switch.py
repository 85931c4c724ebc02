"""Switch the frames of the wide area between the sites in one process, with link impairments.

``python -m sim.namespaces.switch SEED NAME=INTERFACE ..`` connects these interfaces of its namespace by raw sockets, so
the kernel needs no traffic control. The process reads orders as JSON lines and echoes each order when it has taken
effect; the process ends when its input ends. A frame passes three simulated links: out of its site, between the two
sites, and into the other site.
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

from sim.namespaces.impairment import Impairments, LinkDirection

ETH_P_ALL = 3
PACKET, IGNORE_OUTGOING = 263, 23
ETHERNET_HEADER_BYTES = 14
"""Length of an Ethernet header in bytes: two addresses and a type."""
IP_HEADERS_BYTES = ETHERNET_HEADER_BYTES + 20
ETHERTYPE_ARP = b"\x08\x06"
RECEIVE_BUFFER_BYTES = 4 << 20
MAX_FRAMES_AT_ONCE = 64
SNAPLEN_BYTES = 65535
PCAP_HEADER = struct.pack("=IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, SNAPLEN_BYTES, 1)
"""The classic pcap format: magic, version 2.4, no time zone, whole frames, Ethernet."""


class Port:
    """One interface of a site, with a simulated link for each direction."""

    def __init__(self, name: str, interface: str, rng: Random) -> None:
        self.name = name
        self.socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETH_P_ALL))
        self.socket.setsockopt(PACKET, IGNORE_OUTGOING, 1)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        self.socket.bind((interface, 0))
        self.socket.setblocking(False)
        self.up, self.down = LinkDirection(rng), LinkDirection(rng)

    def read_frames(self) -> Iterator[bytes]:
        """Yield received frames, a limited number per call."""
        for _ in range(MAX_FRAMES_AT_ONCE):
            try:
                yield self.socket.recv(SNAPLEN_BYTES)
            except OSError:
                return


class Switch:
    """All ports; a frame is sent to the port of its receiver, or to all ports if that is not known."""

    def __init__(self, ports: dict[str, str], rng: Random) -> None:
        self._rng = rng
        self._ports = {name: Port(name, interface, rng) for name, interface in ports.items()}
        self._ports_by_descriptor = {port.socket.fileno(): port for port in self._ports.values()}
        self._pair_directions: defaultdict[tuple[str, str], LinkDirection] = defaultdict(lambda: LinkDirection(rng))
        self._ports_by_address: dict[bytes, Port] = {}
        self._delayed_frames: list[tuple[float, int, Port, bytes]] = []
        self._number = 0
        self._capture_file: BinaryIO | None = None

    def run(self, orders: int) -> None:
        """Switch frames until the file ``orders`` ends."""
        poll = select.epoll()
        for file in (orders, *self._ports_by_descriptor):
            poll.register(file, select.EPOLLIN)
        rest = b""
        while True:
            wait = -1.0 if not self._delayed_frames else max(0.0, self._delayed_frames[0][0] - time.monotonic())
            for file, _ in poll.poll(wait):
                if file != orders:
                    port = self._ports_by_descriptor[file]
                    for frame in port.read_frames():
                        self._receive_frame(port, frame)
                    continue
                read = os.read(orders, 65536)
                if not read:
                    return
                *lines, rest = (rest + read).split(b"\n")
                for line in lines:
                    sys.stdout.write(json.dumps(self._execute(json.loads(line))) + "\n")
                    sys.stdout.flush()
            now = time.monotonic()
            while self._delayed_frames and self._delayed_frames[0][0] <= now:
                _, _, port, frame = heapq.heappop(self._delayed_frames)
                self._send_frame(port, frame)

    def _receive_frame(self, source: Port, frame: bytes) -> None:
        receiver, sender = frame[:6], frame[6:12]
        self._ports_by_address[sender] = source
        target = None if receiver[0] & 1 else self._ports_by_address.get(receiver)
        targets = [target] if target is not None else [port for port in self._ports.values() if port is not source]
        if self._capture_file is not None:
            self._capture_file.write(make_pcap_record(frame))
        now = time.monotonic()
        for port in targets:
            if port is not source:
                pair_line = self._pair_directions.get((source.name, port.name))
                self._forward_frame(
                    [source.up, *([pair_line] if pair_line is not None else []), port.down], port, frame, now
                )

    def _forward_frame(self, lines: list[LinkDirection], port: Port, frame: bytes, now: float) -> None:
        if frame[12:14] == ETHERTYPE_ARP:
            # ARP is not impaired unless the link is cut: real long-distance links have no ARP, and a retry takes a
            # second.
            if not any(line.impairments.loss == 100.0 for line in lines):
                self._send_frame(port, frame)
            return
        moments = [now]
        for line in lines:
            moments = [later for moment in moments for later in line.draw_delivery_times(len(frame), moment)]
            frame = line.corrupt_frame(frame, IP_HEADERS_BYTES)
        for moment in moments:
            if moment <= now:
                self._send_frame(port, frame)
            else:
                self._number += 1
                heapq.heappush(self._delayed_frames, (moment, self._number, port, frame))

    def _send_frame(self, port: Port, frame: bytes) -> None:
        try:
            port.socket.send(frame)
        except OSError:
            port.down.lost += 1

    def _execute(self, order: dict[str, Any]) -> object:
        match order["do"]:
            case "weather":
                self._find_direction(order).impairments = Impairments(**order["weather"])
            case "count":
                return {name: {"up": port.up.counts, "down": port.down.counts} for name, port in self._ports.items()}
            case "record":
                self._open_capture(order["file"])
        return order

    def _find_direction(self, order: dict[str, Any]) -> LinkDirection:
        if order["to"]:
            return self._pair_directions[order["port"], order["to"]]
        port = self._ports[order["port"]]
        return port.up if order["is_up"] else port.down

    def _open_capture(self, path: str) -> None:
        if self._capture_file is not None:
            self._capture_file.close()
        self._capture_file = None
        if path:
            self._capture_file = open(path, "wb")  # noqa: SIM115 - open until the order to close it
            self._capture_file.write(PCAP_HEADER)


def make_pcap_record(frame: bytes) -> bytes:
    """Return a frame as a pcap record with the current time."""
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
