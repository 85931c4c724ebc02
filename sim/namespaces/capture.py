"""Capture the frames of an interface into a file, and count datagrams by peer.

    with Capture(net, "pub", folder / "pub.pcap") as seen:
        ...
    seen.found([b"red target"]), seen.traffic["198.18.1.2:7000"].amplification

``python -m sim.namespaces.capture INTERFACE FILE`` is the process on the host that captures; ``tcpdump`` is not needed.
"""

from __future__ import annotations

import json
import os
import select
import socket
import struct
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

from sim.namespaces.internet import Internet
from sim.namespaces.nat import WAN
from sim.namespaces.switch import ETH_P_ALL, PCAP_HEADER, SNAPLEN_BYTES, make_pcap_record

OUTGOING = 4
IPV4, UDP = 0x0800, 17


@dataclass
class Traffic:
    """Datagrams and their payload in bytes, from a peer (``received``) and to that peer (``sent``)."""

    received: int = 0
    received_bytes: int = 0
    sent: int = 0
    sent_bytes: int = 0

    @property
    def amplification(self) -> float:
        """Bytes sent to the peer per byte received from it; infinite for a peer that sent nothing."""
        if not self.sent_bytes:
            return 0.0
        return self.sent_bytes / self.received_bytes if self.received_bytes else float("inf")


class Capture:
    """A capture of the interface of ``host`` within a ``with`` block; ``traffic`` is available afterwards."""

    def __init__(self, net: Internet, host: str, file: Path) -> None:
        self.traffic: dict[str, Traffic] = {}
        self.file = file
        arguments = [sys.executable, "-m", "sim.namespaces.capture", WAN, str(file.absolute())]
        self._process = net.start(host, arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def __enter__(self) -> Capture:
        assert self._process.stdout is not None
        if not self._process.stdout.readline():
            raise RuntimeError("the capture did not start")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        output = self._process.communicate(timeout=20)[0]
        self.traffic = {peer: Traffic(**counts) for peer, counts in json.loads(output).items()}

    def from_host(self, address: str) -> Traffic:
        """Return the traffic with all ports of one address."""
        whole = Traffic()
        for peer, each in self.traffic.items():
            if peer.rpartition(":")[0] == address:
                whole.received += each.received
                whole.received_bytes += each.received_bytes
                whole.sent += each.sent
                whole.sent_bytes += each.sent_bytes
        return whole

    def find_plain_text(self, words: Iterable[bytes]) -> list[bytes]:
        """Return the ``words`` that occur in the captured frames in plain text."""
        return find_words(self.file.read_bytes(), words)


def find_words(passed: bytes, words: Iterable[bytes]) -> list[bytes]:
    """Return the ``words`` that occur in ``passed``, in upper or lower case, or as UTF-16."""
    text = passed.lower()
    return [w for w in words if w.lower() in text or w.decode().lower().encode("utf-16-le") in text]


def read_datagrams(file: Path) -> Iterator[tuple[str, str, bytes]]:
    """Yield source, target and payload of the UDP datagrams of a capture file."""
    data, place = file.read_bytes(), len(PCAP_HEADER)
    while place + 16 <= len(data):
        length = struct.unpack_from("=I", data, place + 8)[0]
        held = parse_datagram(data[place + 16 : place + 16 + length])
        if held is not None:
            yield held
        place += 16 + length


def parse_datagram(frame: bytes) -> tuple[str, str, bytes] | None:
    """Return source, target and payload of a frame's datagram; None unless it is UDP over IPv4."""
    if len(frame) < 42 or int.from_bytes(frame[12:14]) != IPV4 or frame[23] != UDP:
        return None
    udp = 14 + 4 * (frame[14] & 15)
    if int.from_bytes(frame[20:22]) & 0x1FFF or len(frame) < udp + 8:
        return None  # a fragment after the first one has no ports
    source_port, target_port, length = struct.unpack_from("!HHH", frame, udp)
    source, target = socket.inet_ntoa(frame[26:30]), socket.inet_ntoa(frame[30:34])
    return f"{source}:{source_port}", f"{target}:{target_port}", frame[udp + 8 : udp + length]


def capture(interface: str, out: BinaryIO, orders: int, ready: Any) -> dict[str, Traffic]:
    """Write frames to ``out`` until the file ``orders`` ends; return the traffic by peer."""
    raw = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETH_P_ALL))
    raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8 << 20)
    raw.bind((interface, 0))
    counts: defaultdict[str, Traffic] = defaultdict(Traffic)
    out.write(PCAP_HEADER)
    ready()
    is_over = False
    files: list[Any] = [raw, orders]
    while not is_over or select.select([raw], [], [], 0.0)[0]:
        readable = [raw] if is_over else select.select(files, [], [])[0]
        is_over = is_over or orders in readable
        if raw not in readable:
            continue
        frame, (_, _, direction, *_) = raw.recvfrom(SNAPLEN_BYTES)
        out.write(make_pcap_record(frame))
        datagram = parse_datagram(frame)
        if datagram is None:
            continue
        source, target, held = datagram
        if direction == OUTGOING:
            counts[target].sent += 1
            counts[target].sent_bytes += len(held)
        else:
            counts[source].received += 1
            counts[source].received_bytes += len(held)
    return counts


def main(interface: str, file: str) -> None:
    """Capture until standard input ends, then print the traffic as JSON."""

    def ready() -> None:
        sys.stdout.write("ready\n")
        sys.stdout.flush()

    with open(file, "wb") as out:
        counts = capture(interface, out, sys.stdin.fileno(), ready)
    sys.stdout.write(json.dumps({peer: vars(each) for peer, each in counts.items()}) + os.linesep)


if __name__ == "__main__":
    main(*sys.argv[1:])
