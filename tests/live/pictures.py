"""Take the pictures of the page in docs/images from a real demonstration.

``python -m tests.live.pictures`` takes all pictures; arguments select scenes by name. The pictures show no mouse
pointer, and have at most 256 colours, so the files stay small.
"""

from __future__ import annotations

import signal
import struct
import sys
import tempfile
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tests.live.demonstration import Demonstration
from tests.live.page import CHROMIUM, DESK, FLAGS, MISSING, PHONE, TABLET, VIEWS, Team

IMAGES = Path(__file__).parents[2] / "docs" / "images"
WALL = {"viewport": {"width": 1920, "height": 1080}}
GAP = 16
GREY = 200
COLOURS = 224
SAMPLED = 20_000
PATIENCE_MS = 60_000
FILM_SIZE = (960, 600)
FILM_QUALITY = 60
Picture = np.ndarray[Any, np.dtype[np.uint8]]


class Photographer:
    """Opens pages of one demonstration and takes pictures of them."""

    def __init__(self, browser: Any, invitation: str) -> None:
        self._browser = browser
        self._invitation = invitation

    def opened(self, screen: dict[str, Any], scheme: str = "light", address: str = "") -> Any:
        """Open a page, by default the page of the demonstration; return the page when it shows the team."""
        context = self._browser.new_context(**screen, color_scheme=scheme, reduced_motion="reduce")
        page = context.new_page()
        page.set_default_timeout(PATIENCE_MS)
        page.goto(address or self._invitation)
        if not address:
            page.locator("#link[data-link=live]").wait_for()
            page.locator(".device").first.wait_for(state="attached")
        return page

    def view(self, page: Any, name: str) -> None:
        """Open a view."""
        page.evaluate(f"location.hash = {name!r}")
        page.locator(f"body[data-view={name}]").wait_for()
        if name == "network":
            page.locator("#round-trips td").first.wait_for()

    def seen(self, page: Any) -> Picture:
        """Return a screenshot of the page."""
        told = page.screenshot()
        picture = cv2.imdecode(np.frombuffer(told, np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None
        return np.asarray(picture, np.uint8)

    def take(self, page: Any, name: str) -> None:
        """Store a screenshot of the page."""
        keep(name, self.seen(page))

    def executing(self, page: Any) -> str:
        """Run the demonstration until a dog acts; return the dog's name."""
        page.locator("#demo").click()
        going = page.locator(".device[data-state=EXECUTING] b")
        going.wait_for(state="attached")
        return str(going.text_content())

    def finished(self, page: Any) -> None:
        """Wait until no task is open."""
        page.locator("#tasks li .badge[data-state=COMPLETED]").first.wait_for(state="attached")
        busy = "#tasks .badge:is([data-state=OPEN], [data-state=ASSIGNED], [data-state=EXECUTING])"
        page.wait_for_function(f"() => !document.querySelector({busy!r})")


def keep(name: str, picture: Picture) -> None:
    """Write one picture."""
    data = packed(picture)
    (IMAGES / f"{name}.png").write_bytes(data)
    sys.stdout.write(f"{name}.png {len(data) // 1000} kB\n")


def beside(pictures: list[Picture]) -> Picture:
    """Return one picture that shows the given pictures side by side at equal height."""
    gap = np.full((pictures[0].shape[0], GAP, 3), GREY, np.uint8)
    row = [each for picture in pictures for each in (picture, gap)][:-1]
    return np.hstack(row)


def packed(picture: Picture) -> bytes:
    """Return a PNG with a palette that is chosen by k-means with a fixed seed."""
    cv2.setRNGSeed(1)
    found = picture.reshape(-1, 3).astype(np.float32)
    some = found[np.random.default_rng(1).integers(0, len(found), SAMPLED)]
    # A rare colour, such as the red of a line of text, counts at least once.
    some = np.vstack([some, np.unique(picture.reshape(-1, 3) // 16 * 16 + 8, axis=0).astype(np.float32)])
    end = (cv2.TERM_CRITERIA_MAX_ITER + cv2.TERM_CRITERIA_EPS, 12, 1.0)
    _, _, centres = cv2.kmeans(some, COLOURS, np.zeros(0, np.int32), end, 1, cv2.KMEANS_PP_CENTERS)
    usual, counts = np.unique(picture.reshape(-1, 3), axis=0, return_counts=True)
    # The colours of background and text, which cover most of the picture, are not approximated.
    exact = usual[np.argsort(-counts)[: 256 - COLOURS]]
    palette = np.vstack([exact, np.rint(centres).astype(np.uint8)])
    cube = np.stack(np.meshgrid(*[np.arange(4, 256, 8)] * 3, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
    nearest = np.array([np.argmin(((palette.astype(np.float32) - each) ** 2).sum(1)) for each in cube], np.uint8)
    flat = picture.reshape(-1, 3)
    index = nearest[(flat[:, 0] >> 3).astype(int) * 1024 + (flat[:, 1] >> 3).astype(int) * 32 + (flat[:, 2] >> 3)]
    whole = (flat.astype(np.uint32) << np.array([16, 8, 0], np.uint32)).sum(1)
    for number, colour in enumerate(exact):
        index[whole == int(colour[0]) << 16 | int(colour[1]) << 8 | int(colour[2])] = number
    height, width = picture.shape[:2]
    rows = np.hstack([np.zeros((height, 1), np.uint8), index.reshape(height, width)]).tobytes()

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0)
    parts = ((b"IHDR", head), (b"PLTE", palette[:, ::-1].tobytes()), (b"IDAT", zlib.compress(rows, 9)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(kind, data) for kind, data in parts)


def quiet(photographer: Photographer, demo: Demonstration) -> None:
    """Take pictures before the first task."""
    desktop, phone = photographer.opened(DESK), photographer.opened(PHONE)
    desktop.locator("figure[data-camera=live]").nth(2).wait_for()
    photographer.take(desktop, "devices")
    photographer.view(phone, "tasks")
    phone.locator("#group").fill("yard")
    phone.locator("[data-can=with]").wait_for()
    phone.locator("#h-tasks").click()
    photographer.take(phone, "assign-phone")
    signin = photographer.opened(PHONE, address=demo.url)
    signin.locator("#signin-code").wait_for()
    photographer.take(signin, "signin-phone")


def running(photographer: Photographer) -> None:
    """Take pictures on each screen while a dog acts."""
    screens = {
        "demo-desktop": photographer.opened(DESK),
        "demo-desktop-dark": photographer.opened(DESK, "dark"),
        "views-wall": photographer.opened(WALL, "dark"),
        "views-tablet": photographer.opened(TABLET),
        "demo-phone": photographer.opened(PHONE),
    }
    cameras = photographer.opened(PHONE)
    photographer.view(cameras, "cameras")
    for page in screens.values():
        page.locator("figure[data-camera=live]").nth(2).wait_for() if page.viewport_size["width"] > 800 else None
    photographer.executing(screens["demo-desktop"])
    seen = {name: photographer.seen(page) for name, page in [*screens.items(), ("demo-phone-cameras", cameras)]}
    for name, picture in seen.items():
        keep(name, picture)
    photographer.finished(screens["demo-desktop"])
    for page in (*screens.values(), cameras):
        page.context.close()


def lost(photographer: Photographer, demo: Demonstration) -> None:
    """Take pictures of all views after the acting dog has lost its network and another dog has taken over."""
    desktop = photographer.opened(DESK)
    phones = {scheme: photographer.opened(PHONE, scheme) for scheme in ("light", "dark")}
    photographer.view(phones["dark"], "groups")
    name = photographer.executing(desktop)
    phones["dark"].locator(".point[data-agree=true]").wait_for()
    groups = photographer.seen(phones["dark"])
    uuid = next(device["uuid"] for device in demo.api("devices") if device["name"] == name)
    desktop.evaluate(f"location.hash = 'device/{uuid}'")
    desktop.locator(".fault-buttons button").first.wait_for()
    desktop.get_by_role("button", name="Cut radio").click()
    desktop.locator("#place-device .fault", has_text="took over after").wait_for()
    desktop.locator("#place-device .fault").evaluate("e => e.scrollIntoView({ block: 'end' })")
    photographer.take(desktop, "faults-desktop")
    desktop.get_by_role("button", name="Close").click()
    photographer.finished(desktop)
    sheets = {"light": ["devices", "tasks", "cameras", "map"], "dark": ["network", "events", "more"]}
    assert sorted([*sheets["light"], *sheets["dark"], "groups"]) == sorted(VIEWS)
    taken: dict[str, list[Picture]] = {"light": [], "dark": [groups]}
    for scheme, views in sheets.items():
        for view in views:
            photographer.view(phones[scheme], view)
            phones[scheme].wait_for_timeout(600)
            taken[scheme].append(photographer.seen(phones[scheme]))
    keep("views-phone", beside(taken["light"]))
    keep("views-phone-dark", beside(taken["dark"]))
    for page in (desktop, *phones.values()):
        page.context.close()


def takeover(photographer: Photographer, demo: Demonstration) -> None:
    """Record a takeover as an animation: the acting dog's node is killed, and another dog gets the task."""
    desktop = photographer.opened(DESK)
    frames: list[Picture] = []
    times: list[float] = []

    def film(seconds: float) -> None:
        end = time.monotonic() + seconds
        while (now := time.monotonic()) < end:
            times.append(now)
            frames.append(cv2.resize(photographer.seen(desktop), FILM_SIZE, interpolation=cv2.INTER_AREA))  # type: ignore[arg-type]

    name = photographer.executing(desktop)
    film(2.0)
    demo.send_signal(name, signal.SIGKILL)
    film(7.0)
    animation = cv2.Animation()
    animation.frames = frames
    ends = [*times[1:], times[-1] + 3.0]
    animation.durations = [round(1000 * (end - begin)) for begin, end in zip(times, ends, strict=True)]
    path = IMAGES / "takeover.webp"
    cv2.imwriteanimation(str(path), animation, [cv2.IMWRITE_WEBP_QUALITY, FILM_QUALITY])
    sys.stdout.write(f"{path.name} {path.stat().st_size // 1000} kB, {len(frames)} frames\n")
    photographer.finished(desktop)
    desktop.context.close()


def opened(photographer: Photographer, demo: Demonstration) -> None:
    """Take pictures of a device's dialog."""
    (uuid,) = [device["uuid"] for device in demo.api("devices") if device["name"] == "dog2"]
    for screen, scheme, name in ((DESK, "dark", "device-desktop"), (PHONE, "light", "device-phone")):
        page = photographer.opened(screen, scheme)
        page.evaluate(f"location.hash = 'device/{uuid}'")
        page.locator("dialog[open] .setting").first.wait_for()
        photographer.take(page, name)
        page.context.close()


def stopped(photographer: Photographer) -> None:
    """Take a picture of the stopped team."""
    phone = photographer.opened(PHONE)
    phone.locator("#demo").click()
    phone.locator(".device[data-state=SEARCHING]").nth(2).wait_for()
    phone.locator(".stop").click()
    phone.locator(".halted").wait_for()
    phone.locator("#status-line", has_text="Stopped: 3 robots stand").wait_for()
    photographer.take(phone, "stop-phone")
    phone.locator(".halted button").click()


def outdoors(browser: Any) -> None:
    """Take a picture of positions on a map without a simulator, using the team of the tests."""
    team = Team()
    try:
        team.order("outdoors")
        for place in ("dog1 lat=48.13708 lon=11.57540 accuracy=4", "dog2 lat=48.13731 lon=11.57604 accuracy=9"):
            team.order(f"place {place}")
        team.order("place dog3 lat=48.13752 lon=11.57525 accuracy=6")
        photographer = Photographer(browser, f"{team.url}#code={team.code}")
        phone = photographer.opened(PHONE)
        photographer.view(phone, "map")
        phone.locator("#position-map .spot").nth(2).wait_for()
        phone.wait_for_timeout(300)
        photographer.take(phone, "map-phone")
    finally:
        team.stop()


def main(wanted: list[str]) -> int:
    """Take all pictures, or only the ``wanted`` scenes."""
    if MISSING:
        sys.stdout.write(f"missing {'; '.join(MISSING)}\n")
        return 1
    from playwright.sync_api import sync_playwright

    with tempfile.TemporaryDirectory() as folder, sync_playwright() as play:
        browser = play.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        demo = Demonstration(Path(folder) / "log", "--run-dir", str(Path(folder) / "run"), "--web-port", "0")
        try:
            photographer = Photographer(browser, demo.invitation)
            scenes: dict[str, Callable[[], None]] = {
                "quiet": lambda: quiet(photographer, demo),
                "running": lambda: running(photographer),
                "lost": lambda: lost(photographer, demo),
                "opened": lambda: opened(photographer, demo),
                "stopped": lambda: stopped(photographer),
                "outdoors": lambda: outdoors(browser),
                # This scene permanently ends a node of the demonstration.
                "takeover": lambda: takeover(photographer, demo),
            }
            for name, scene in scenes.items():
                if not wanted or name in wanted:
                    scene()
        finally:
            demo.stop()
            browser.close()
    total = sum(path.stat().st_size for path in IMAGES.glob("*.png"))
    sys.stdout.write(f"docs/images: {total // 1000} kB\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
