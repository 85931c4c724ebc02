"""Measure the demonstration: memory and processor time of every process, datagrams, and the size of the page.

``make bench-demo`` starts the real demonstration, opens its page as a browser does (three cameras and the event
stream), runs the task, and prints a table. Linux only: the figures come from ``/proc``.
"""

from __future__ import annotations

import argparse
import http.client
import json
import random
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from benchmarks.measure import read_cpu_s, read_maps_mib, read_udp_counter
from middleware.admission import operator as operators
from middleware.admission.membership_file import MembershipFile, create_membership_file

START_LIMIT_S = 60.0
TASK_LIMIT_S = 120.0
TARGETS = {"pss": 300.0, "cores": 1.0, "page": 60_000, "plain": 40.0}
"""Limits: MiB of all processes, cores of all processes, bytes of the page, MiB of a robot's node without vision."""


class PageClient:
    """An HTTP client for the demonstration's page at ``url``."""

    def __init__(self, url: str) -> None:
        self._host = urlsplit(url).netloc
        self.headers = {"X-Swarm": "1"}
        code = urlsplit(url).fragment.removeprefix("code=")
        signed = json.loads(self.request("/api/v1/session", "POST", body=json.dumps({"code": code}))[1])
        self.headers["Authorization"] = f"Bearer {signed['token']}"

    def request(
        self, path: str, method: str = "GET", limit_s: float = 10.0, body: str | None = None
    ) -> tuple[http.client.HTTPResponse, bytes]:
        """Send one request on a new connection."""
        connection = http.client.HTTPConnection(self._host, timeout=limit_s)
        try:
            connection.request(method, path, body, self.headers)
            response = connection.getresponse()
            return response, response.read()
        finally:
            connection.close()

    def read_state(self) -> dict[str, Any]:
        """Return the state that the page shows."""
        state: dict[str, Any] = json.loads(self.request("/api/v1/state")[1])
        return state

    def measure_size(self) -> dict[str, int]:
        """Return the uncompressed bytes of the page and of everything that it loads from the node."""
        sizes: dict[str, int] = {}
        waiting = ["/"]
        while waiting:
            path = waiting.pop()
            if path in sizes:
                continue
            body = self.request(path)[1]
            sizes[path] = len(body)
            found = re.findall(rb'(?:href|src)="(/static/[^"]+)"', body) if path == "/" else []
            if path.endswith(".js"):
                found = [b"/static/" + name for name in re.findall(rb'(?:from|import) "\./([^"]+)"', body)]
            waiting += [name.decode() for name in found]
        return sizes


class Viewer:
    """An open page: the event stream, and the pictures of each camera at full rate."""

    def __init__(self, page: PageClient, host: str) -> None:
        self._page = page
        self._host = host
        self._is_stopping = False
        self._threads: list[threading.Thread] = []
        self.pictures = 0
        self.bytes = 0

    def open(self) -> None:
        """Open the streams."""
        cameras = [
            device["uuid"] for device in self._page.read_state()["devices"] if "camera" in device["capabilities"]
        ]
        works: list[Callable[[], None]] = [self._stream_events, *(self._make_camera_stream(uuid) for uuid in cameras)]
        self._threads = [threading.Thread(target=work, daemon=True) for work in works]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Close the streams."""
        self._is_stopping = True
        for thread in self._threads:
            thread.join(6.0)

    def _make_camera_stream(self, uuid: str) -> Callable[[], None]:
        def look() -> None:
            connection = http.client.HTTPConnection(self._host, timeout=10)
            after = "0"
            while not self._is_stopping:
                connection.request("GET", f"/shot/{uuid}?after={after}&viewer=bench", headers=self._page.headers)
                response = connection.getresponse()
                picture = response.read()
                after = response.headers.get("X-Seq", after)
                if response.status == 200:
                    self.pictures += 1
                    self.bytes += len(picture)
            connection.close()

        return look

    def _stream_events(self) -> None:
        connection = http.client.HTTPConnection(self._host, timeout=10)
        connection.request("GET", "/events", headers=self._page.headers)
        response = connection.getresponse()
        while not self._is_stopping:
            line = response.readline()
            self.bytes += len(line)
        connection.close()


def list_descendants(root: int) -> dict[int, str]:
    """Return ``root`` and its descendant processes by id, each with its name."""
    parents: dict[int, int] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parents[int(entry.name)] = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            except (OSError, IndexError, ValueError):
                continue
    found = [root]
    for pid in found:
        found += [child for child in sorted(parents) if parents[child] == pid]
    return {pid: _process_name(pid) for pid in found}


def _process_name(pid: int) -> str:
    try:
        words = Path(f"/proc/{pid}/cmdline").read_text().split("\0")
    except OSError:
        return "ended"
    configuration = next((Path(word).stem for word in words if word.endswith(".toml")), "")
    return configuration or next((word for word in words if word in ("sim.robots.server", "sim.demo")), words[0])


@contextmanager
def run_demonstration(run_dir: Path, seed: int) -> Iterator[tuple[subprocess.Popen[str], str, float]]:
    """Start the demonstration; yield its process, the page's address, and the seconds until it was ready."""
    started_at = time.monotonic()
    command = [sys.executable, "-m", "sim.demo", "--seed", str(seed), "--run-dir", str(run_dir)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        for line in process.stdout:
            found = re.match(r"The page: (\S+)", line)
            if found:
                threading.Thread(target=process.stdout.read, daemon=True).start()
                yield process, found[1], time.monotonic() - started_at
                return
        raise SystemExit("bench-demo: the demonstration ended before its page was up; run it alone to see why")
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(15)


@contextmanager
def run_plain_node(run_dir: Path) -> Iterator[int]:
    """Start a robot's node without agent and camera in the team of ``run_dir``; yield its process id."""
    dog = tomllib.loads((run_dir / "dog1.toml").read_text())["node"]
    known = json.dumps(dog["known_nodes"])
    file, path = run_dir / "plain.toml", run_dir / "plain.membership"
    secret = MembershipFile(Path(dog["membership"])).membership.secrets[0][1]
    operator = operators.load_operator(run_dir / "operator.key")
    create_membership_file(
        path, operator.create_membership("plain", ("device",), time.time(), random.SystemRandom(), secret)
    )
    file.write_text(
        f'[node]\nname = "plain"\nmembership = "{path.name}"\nknown_nodes = {known}\nstore = "plain.sqlite"\n'
        '[driver]\nkind = "sim"\noptions = { robot = "dog1", camera = false }\n'
    )
    twistd = str(Path(sys.executable).parent / "twistd")
    command = [twistd, "-n", "--pidfile=", "swarm-node", "--config", str(file)]
    process = subprocess.Popen([sys.executable, *command], stdout=subprocess.DEVNULL, stderr=subprocess.STDOUT)
    try:
        yield process.pid
    finally:
        process.terminate()
        process.wait(15)


def measure_task(page: PageClient, least_s: float) -> float:
    """Press Run Demo and return the seconds until the task is completed; wait at least ``least_s``."""
    task = json.loads(page.request("/api/v1/demo", "POST")[1])["id"]
    started_at, elapsed = time.monotonic(), 0.0
    while not elapsed or time.monotonic() - started_at < least_s:
        if time.monotonic() - started_at > TASK_LIMIT_S:
            raise SystemExit(f"bench-demo: the task was not completed within {TASK_LIMIT_S:g} s")
        done = [row["id"] for row in page.read_state()["tasks"] if row["status"] == "COMPLETED"]
        if not elapsed and task in done:
            elapsed = time.monotonic() - started_at
        time.sleep(0.5)
    return elapsed


def _format_line(what: str, value: float, unit: str, target: str, note: str = "") -> str:
    limit = TARGETS[target]
    shown = f"{value:8.2f}" if value < 10 else f"{value:8.1f}" if value < 1000 else f"{value:8.0f}"
    return f"{what:20}{shown} {unit:9} target {limit:g}: {'held' if value <= limit else 'MISSED'}{note}"


def measure(seed: int, seconds: float, run_dir: Path) -> list[str]:
    """Measure and return the lines of the table."""
    with run_demonstration(run_dir, seed) as (process, url, ready_s):
        page = PageClient(url)
        host = urlsplit(url).netloc
        names = list_descendants(process.pid)
        viewer = Viewer(page, host)
        viewer.open()
        time.sleep(2.0)
        before, heard, started_at = (
            {pid: read_cpu_s(pid) for pid in names},
            read_udp_counter("InDatagrams"),
            time.monotonic(),
        )
        pictures, carried = viewer.pictures, viewer.bytes
        took = measure_task(page, seconds)
        span = time.monotonic() - started_at
        shares = {pid: (read_cpu_s(pid) - before[pid]) / span for pid in names}
        rate = (read_udp_counter("InDatagrams") - heard) / span
        pictures, carried = viewer.pictures - pictures, viewer.bytes - carried
        sizes = {pid: read_maps_mib(pid) for pid in names}
        viewer.close()
        with run_plain_node(run_dir) as plain:
            time.sleep(6.0)
            plain_maps = read_maps_mib(plain)
            joined = "plain" in [device["name"] for device in page.read_state()["devices"]]
        weight = page.measure_size()
    lines = [f"{'process':12}{'PSS MiB':>9}{'RSS MiB':>9}{'cores':>8}"]
    for pid, name in names.items():
        lines.append(f"{name:12}{sizes[pid]['Pss']:9.1f}{sizes[pid]['Rss']:9.1f}{shares[pid]:8.3f}")
    pss, cores, page_bytes = sum(size["Pss"] for size in sizes.values()), sum(shares.values()), sum(weight.values())
    joining = "" if joined else " (IT HAS NOT JOINED)"
    lines += [
        "",
        _format_line("memory of all", pss, "MiB PSS", "pss"),
        _format_line("processor of all", cores, "cores", "cores", f" (over {span:.0f} s, task and page running)"),
        _format_line("page", page_bytes, "bytes", "page", f" ({len(weight)} files, uncompressed)"),
        _format_line(
            "node without vision", plain_maps["Rss"], "MiB RSS", "plain", f" (PSS {plain_maps['Pss']:.1f}){joining}"
        ),
        f"ready after         {ready_s:8.1f} s; the task took {took:.1f} s",
        f"one open page       {pictures / span:8.1f} pictures a second, {carried / span / 1000:.0f} kB/s",
        f"datagrams           {rate:8.0f} a second (all of this machine's UDP)",
    ]
    return lines


def main(arguments: Sequence[str]) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.demo", description="Measure the demonstration.")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--seconds",
        type=float,
        default=20.0,
        help="minimum time of the measurement of the processor (default %(default)s)",
    )
    args = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        lines = measure(args.seed, args.seconds, Path(folder) / "run")
    sys.stdout.write("\n".join(lines) + "\n")
    return 1 if any("MISSED" in line or "NOT JOINED" in line for line in lines) else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
