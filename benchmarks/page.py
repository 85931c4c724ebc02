"""Load the page: ``python -m benchmarks.page``.

The load is 200 event streams, 12 camera viewers of three robots at 30 pictures a second, 500 clients that send a byte a
second, and 100 requests a second, each kind from 64 addresses of this machine. In addition there is one viewer on a
slow link. The program prints the starved streams, the age of pictures, the delay of the web node's timers and its
memory, and exits with 1 if a target is missed. The age of a picture is measured from the robot's process, over UDP and
the web node, to the viewer's process; it does not include the camera and the screen.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import resource
import socket
import struct
import sys
import time
from collections.abc import Callable, Coroutine, Sequence
from typing import Any

from benchmarks.measure import ChildProcess, percentile
from benchmarks.page_team import CODE, JPEG_START, ROBOTS
from sim.demo import free_ports

ADDRESSES = 64
DRIBBLE_S = 1.0
ARRIVAL_S = 5.0
"""Seconds within which all clients connect; measurements start after that."""
SLOW_BYTES = 32_000
"""Bytes a second of the slow link; a picture has 6,000 bytes."""
TARGETS = {"api": 100.0, "closed": 15.0, "late": 50.0, "memory": 30.0, "lag": 0.5, "glass": 300.0, "unfed": 0.0}


class Connection:
    """One connection to the page from a separate source address."""

    def __init__(self, where: int, number: int, window: int = 0) -> None:
        self._where = where
        self._from = f"127.0.1.{1 + number % ADDRESSES}"
        self._window = window

    async def __aenter__(self) -> Connection:
        raw = socket.socket()
        raw.setblocking(False)
        if self._window:
            raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, self._window)
        raw.bind((self._from, 0))
        await asyncio.get_running_loop().sock_connect(raw, ("127.0.0.1", self._where))
        limit = self._window or 1 << 16
        self.reader, self.writer = await asyncio.open_connection(sock=raw, limit=limit)
        return self

    async def __aexit__(self, *_: object) -> None:
        self.writer.close()

    async def request(self, path: str, method: str = "GET", body: str = "") -> tuple[int, dict[str, str]]:
        """Send one request; return the status and the headers of the answer."""
        head = f"{method} {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Swarm: 1\r\nContent-Length: {len(body)}\r\n\r\n"
        self.writer.write(head.encode() + body.encode())
        lines = (await self.reader.readuntil(b"\r\n\r\n")).decode().split("\r\n")
        headers = {name.lower(): value.strip() for name, _, value in (line.partition(":") for line in lines[1:])}
        return int(lines[0].split()[1]), headers

    async def request_body(self, path: str, method: str = "GET", body: str = "") -> tuple[int, dict[str, str], bytes]:
        """Send one request; return status, headers and body."""
        status, headers = await self.request(path, method, body)
        return status, headers, await self.reader.readexactly(int(headers.get("content-length", 0)))


class PageLoad:
    """All clients of one web node, and their measurements."""

    def __init__(self, where: int, ticket: str, uuids: Sequence[str]) -> None:
        self.beats: dict[int, float] = {}
        self.longest = 0.0
        self.ages: list[float] = []
        self.slow: list[float] = []
        self.closed: list[float] = []
        self.answers: list[float] = []
        self.refused = 0
        self._where = where
        self._ticket = ticket
        self._uuids = uuids

    def reset(self) -> None:
        """Restart the measurements, after all clients have connected."""
        self.longest = 0.0
        for each in (self.ages, self.slow, self.answers):
            each.clear()

    async def run_page(self, number: int) -> None:
        """Run one open page."""
        async with Connection(self._where, number) as line:
            await line.request(f"/events?ticket={self._ticket}")
            self.beats[number] = time.monotonic()
            while True:
                if (await line.reader.readline()).startswith(b"event: beat"):
                    now = time.monotonic()
                    self.longest = max(self.longest, now - self.beats[number])
                    self.beats[number] = now

    async def run_camera_viewer(self, number: int) -> None:
        """Run one viewer of a camera at full rate."""
        async with Connection(self._where, number) as line:
            after = ""
            while True:
                status, headers, body = await line.request_body(self._make_image_path(number, after))
                if status == 200:
                    after = headers["x-seq"]
                    self.ages.append(_read_age(body))

    async def run_slow_viewer(self, number: int) -> None:
        """Run one viewer on a slow link, and measure the age of each picture when it is complete."""
        async with Connection(self._where, number, 4096) as line:
            after = ""
            while True:
                status, headers = await line.request(self._make_image_path(number, after))
                size, body = int(headers.get("content-length", 0)), b""
                while len(body) < size:
                    body += await line.reader.read(min(1000, size - len(body)))
                    await asyncio.sleep(1000 / SLOW_BYTES)
                if status == 200:
                    after = headers["x-seq"]
                    self.slow.append(_read_age(body))

    async def run_dribbler(self, number: int) -> None:
        """Run one client that sends a byte a second, until it is disconnected."""
        async with Connection(self._where, number) as line:
            started_at = time.monotonic()
            over = asyncio.ensure_future(line.reader.read())
            for byte in b"GET /" + b"a" * 1000:
                line.writer.write(bytes([byte]))
                if (await asyncio.wait([over], timeout=DRIBBLE_S))[0]:
                    break
            self.closed.append(time.monotonic() - started_at)

    async def send_requests(self, rate: float) -> None:
        """Send ``rate`` requests a second in total, each timed from its scheduled time."""
        await asyncio.gather(*(self._send_requests_of(number, rate / 20, number / rate) for number in range(20)))

    async def _send_requests_of(self, number: int, rate: float, first: float) -> None:
        due = time.monotonic() + first
        async with Connection(self._where, number) as line:
            while True:
                await asyncio.sleep(max(0.0, due - time.monotonic()))
                status, _, _ = await line.request_body(f"/api/v1/state?ticket={self._ticket}")
                self.answers.append(time.monotonic() - due)
                self.refused += status != 200
                due += 1 / rate

    def _make_image_path(self, number: int, after: str) -> str:
        uuid = self._uuids[number % len(self._uuids)]
        return f"/shot/{uuid}?after={after}&viewer=bench{number}&ticket={self._ticket}"


def _read_age(picture: bytes) -> float:
    return time.monotonic() - float(struct.unpack("!d", picture[len(JPEG_START) : len(JPEG_START) + 8])[0])


async def sign_in(where: int) -> tuple[str, list[str]]:
    """Return a ticket, and the robots' uuids as soon as all robots are present."""
    async with Connection(where, 0) as line:
        _, _, body = await line.request_body("/api/v1/session", "POST", json.dumps({"code": CODE}))
        ticket = json.loads(body)["ticket"]
        for _ in range(200):
            _, _, body = await line.request_body(f"/api/v1/devices?ticket={ticket}")
            found = {device["name"]: device["uuid"] for device in json.loads(body)}
            if set(ROBOTS) <= set(found):
                return ticket, [found[name] for name in ROBOTS]
            await asyncio.sleep(0.1)
    raise SystemExit("bench-page: the robots did not join in time")


async def measure(given: Any, web: ChildProcess, where: int) -> list[str]:
    """Measure and return the lines of the table."""
    ticket, uuids = await sign_in(where)
    load = PageLoad(where, ticket, uuids)
    await asyncio.sleep(2)
    before = web.request_report()
    kinds = [
        (load.run_page, given.streams),
        (load.run_camera_viewer, given.cameras),
        (load.run_dribbler, given.dribblers),
    ]
    tasks = [
        asyncio.ensure_future(_run_after(ARRIVAL_S * number / count, client, number))
        for client, count in kinds
        for number in range(count)
    ]
    tasks += [asyncio.ensure_future(load.run_slow_viewer(1)), asyncio.ensure_future(load.send_requests(given.rate))]
    await asyncio.sleep(ARRIVAL_S + 1)
    load.reset()
    midway = web.request_report()
    await asyncio.sleep(given.seconds)
    after = web.request_report()
    unfed = given.streams - sum(time.monotonic() - at < 2 for at in load.beats.values())
    open_still = given.dribblers - len(load.closed)
    broken = [task for task in tasks if task.done() and task.exception() is not None]
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    rate = len(load.ages) / given.seconds / max(1, given.cameras)
    late, age = 1000 * percentile(load.answers, 0.99), 1000 * percentile(load.ages, 0.95)
    return [
        _format_line(
            "streams not fed", unfed, "of them", "unfed", f" (longest time without a beat {load.longest:.2f} s)"
        ),
        _format_line("API, 99 of 100", late, "ms", "api", f" ({len(load.answers)} answers)"),
        _format_line("picture's age, p95", age, "ms", "glass", f" ({rate:.1f} a second and viewer)"),
        _format_line("slow viewer, oldest", max(load.slow, default=99.0), "s", "lag", f" ({len(load.slow)} pictures)"),
        _format_line(
            "slow clients closed", max(load.closed, default=0.0), "s", "closed", f" ({open_still} are still open)"
        ),
        _format_line("timers late", after["late_ms"], "ms", "late", f" (99 of 100: {after['late_p99_ms']:.1f} ms)"),
        _format_line("memory more", after["rss"] - before["rss"], "MiB", "memory", f" (of {after['rss']:.0f})"),
        f"processor             {(after['processor_s'] - midway['processor_s']) / given.seconds:8.2f} of one core",
        *([f"{load.refused} requests were REFUSED"] if load.refused else []),
        *([f"{len(broken)} clients BROKE: {broken[0].exception()!r}"] if broken else []),
        *([f"{open_still} slow clients MISSED: still open"] if open_still and given.seconds > 20 else []),
    ]


async def _run_after(seconds: float, client: Callable[[int], Coroutine[Any, Any, None]], number: int) -> None:
    await asyncio.sleep(seconds)
    await client(number)


def _format_line(what: str, value: float, unit: str, target: str, note: str) -> str:
    limit = TARGETS[target]
    return f"{what:22}{value:8.2f} {unit:8} target {limit:g}: {'held' if value <= limit else 'MISSED'}{note}"


def main(arguments: Sequence[str]) -> int:
    """Load, measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.page", description="Load the page and measure it.")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--streams", type=int, default=200)
    parser.add_argument("--cameras", type=int, default=12)
    parser.add_argument("--dribblers", type=int, default=500)
    parser.add_argument("--rate", type=float, default=100.0, help="requests a second")
    args = parser.parse_args(arguments)
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    # Both ends of each connection count as open files; the child processes inherit this limit.
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(4096, most), most))
    udp, where = (
        free_ports.find_free_ports("udp", "127.0.0.1", 1)[0],
        free_ports.find_free_ports("tcp", "127.0.0.1", 1)[0],
    )
    web = ChildProcess("benchmarks.page_team", "web", udp, where)
    robots = ChildProcess("benchmarks.page_team", "robots", udp)
    try:
        for child in (web, robots):
            child.read()
        lines = asyncio.run(measure(args, web, where))
    finally:
        robots.end()
        web.end()
    sys.stdout.write("\n".join(lines) + "\n")
    return 1 if any(word in line for line in lines for word in ("MISSED", "REFUSED", "BROKE")) else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
