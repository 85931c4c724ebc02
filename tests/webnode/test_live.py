"""Tests of ``webnode.live``."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase
from twisted.web.resource import Resource

from tests.webnode.browser import Connection, site_of
from tests.webnode.memory import MemoryFrames, MemoryTeamControl
from tests.webnode.picture import jpeg
from webnode.auth import OpenSessions, User
from webnode.camera import OnFrame
from webnode.errors import Refusal
from webnode.event_log import EventLog
from webnode.failover import Page
from webnode.live import MAX_VIEWERS, MAX_WAITING, RENEWAL_LEAD_S, CameraImages, EventStreams
from webnode.services import Services
from webnode.state import State
from webnode.state_journal import MAX_CHANGES

MORE = "x" * 999
"""Text that makes a state longer than a few changes."""
JPEG = jpeg()


def events_in(data: bytes) -> list[tuple[str, Any]]:
    blocks = [block for block in data.decode().split("\n") if block.startswith(("event: ", "data: "))]
    return [
        (name.removeprefix("event: "), json.loads(words.removeprefix("data: ")))
        for name, words in zip(blocks[::2], blocks[1::2], strict=True)
    ]


def last_id(data: bytes) -> str:
    return data.decode().rpartition("id: ")[2].split("\n")[0]


class Quiet(EventLog):
    """An event log that contains only injected faults."""

    def record_state(self, state: State, now: float) -> None:
        """Ignore the state."""


class EventStreamsTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.clock = Clock()
        self.state: dict[str, Any] = {"n": 0}
        self.reads = 0
        self.version: int | None = None
        self.services = Services(MemoryTeamControl(), OpenSessions(), event_log=Quiet())
        self.serve(self.read)

    def serve(self, read: Callable[[], State]) -> None:
        """Serve the states that ``read`` returns."""
        wall = lambda: 1e9 + self.clock.seconds()  # noqa: E731
        self.events = EventStreams(read, self.clock, wall, self.services, lambda: self.version)
        root = Resource()
        root.putChild(b"events", self.events)
        self.site = site_of(root, self.clock)

    def read(self) -> dict[str, Any]:
        self.reads += 1
        return dict(self.state)

    def connected(self, query: str = "", **headers: str) -> Connection:
        return Connection(self.site).ask(f"/events{query}", **headers)

    def test_start_with_everything(self) -> None:
        """A new page immediately receives the state, the map, the list of web pages and the first beat.

        The response is not cached.
        """
        data = self.connected().taken()
        self.assertIn(b"text/event-stream", data)
        self.assertIn(b"no-store", data)
        beat = {"now": 1e9, "skipped": 0}
        told: list[Any] = [("state", {"resync": False, "n": 0}), ("yard", None), ("pages", []), ("beat", beat)]
        self.assertEqual(events_in(data), told)

    def test_tell_changes_only(self) -> None:
        """A change is sent once, within a tenth of a second; without changes only five beats per second are sent."""
        page = self.connected()
        page.taken()
        self.state["n"] = 1
        self.clock.advance(0.1)
        self.assertEqual(events_in(page.taken()), [("change", {"n": 1})])
        self.clock.pump([0.1] * 20)
        told = events_in(page.taken())
        self.assertEqual({name for name, _ in told}, {"beat"})
        self.assertIn(len(told), (9, 10, 11))

    def test_spare_the_node_of_a_large_team(self) -> None:
        """If building the state takes a quarter of a second, it is built once per second, and no change is lost."""
        read = self.read

        def slow() -> dict[str, Any]:
            self.clock.rightNow += 0.25
            return read()

        self.serve(slow)
        page = self.connected()
        page.taken()
        before, began = self.reads, self.clock.seconds()
        while self.clock.seconds() < began + 10.0:
            self.state["n"] += 1
            self.clock.advance(0.1)
        self.assertIn(self.reads - before, (8, 9, 10))
        self.clock.pump([0.1] * 30)
        told = [data["n"] for name, data in events_in(page.taken()) if name == "change"]
        self.assertEqual(told[-1], self.state["n"])

    def test_tell_programs_whole_states(self) -> None:
        """A program that requests whole states receives a state after each change."""
        program = self.connected("?whole=1")
        program.taken()
        self.state["n"] = 1
        self.clock.advance(0.1)
        self.assertEqual(events_in(program.taken()), [("state", {"resync": False, "n": 1})])

    def test_resume(self) -> None:
        """A page that reconnects with its last id, in a header or the query, receives only the changes it missed."""
        self.state["more"] = MORE
        page = self.connected()
        heard = last_id(page.taken())
        page.leave()
        watcher = self.connected()
        for n in (1, 2):
            self.state["n"] = n
            self.clock.advance(0.1)
        for back in (self.connected(f"?since={heard}"), self.connected(Last_Event_ID=heard)):
            told = [event for event in events_in(back.taken()) if event[0] in ("state", "change")]
            self.assertEqual(told, [("change", {"n": 1}), ("change", {"n": 2})])
        whole = ("state", {"resync": True, "n": 2, "more": MORE})
        self.assertIn(whole, events_in(self.connected("?since=other-3").taken()))
        watcher.leave()

    def test_end_with_the_session(self) -> None:
        """An hour before its session ends, a stream warns once if the session can be renewed.

        At the end the stream ends.
        """
        whos = {"short": (10.0, 10.0), "long": (RENEWAL_LEAD_S + 5.0, 2e9), "open": (2e9, 2e9)}

        class Sessions(OpenSessions):
            def authenticate(self, token: str, now: float) -> User:
                until, limit = whos[token]
                is_in = now - 1e9 < until
                return User("ann", "viewer", "a1", 1e9 + until, 1e9 + limit) if is_in else User()

        self.services.sessions = Sessions()
        pages = {name: self.connected(f"?ticket={name}") for name in whos}
        self.clock.pump([0.1] * 80)
        tickets = {
            name: [data for event, data in events_in(page.taken()) if event == "ticket"] for name, page in pages.items()
        }
        self.assertEqual(tickets, {"short": [], "long": [{"until": 1e9 + RENEWAL_LEAD_S + 5.0}], "open": []})
        self.assertEqual(self.events.viewers, 3)
        self.clock.pump([0.1] * 30)
        self.assertEqual(self.events.viewers, 2)
        whos["open"] = (0.0, 0.0)  # signed out
        self.clock.pump([0.1] * 12)
        self.assertEqual(self.events.viewers, 1)

    def test_tell_pages(self) -> None:
        """Every open page is notified of a web node that joins the team."""
        page = self.connected()
        page.taken()
        self.services.fallbacks.pages.append(Page("01", "http://127.0.0.1:8081"))
        self.clock.advance(0.1)
        row = {"node": "01", "url": "http://127.0.0.1:8081", "is_secure": False, "is_self": False}
        self.assertEqual(events_in(page.taken()), [("pages", [row])])

    def test_tell_what_happened(self) -> None:
        """Each entry of the event log is sent to each page once; a new page receives all entries."""
        page = self.connected()
        page.taken()
        self.services.event_log.record_fault("01", "kill", 1e9)
        self.clock.advance(0.1)
        ((name, (row,)),) = events_in(page.taken())
        self.assertEqual((name, row["n"], row["text"]), ("event", 1, "01: kill (injected fault)"))
        self.clock.advance(0.1)
        self.assertEqual([each for each in events_in(page.taken()) if each[0] == "event"], [])
        self.assertIn("event", [name for name, _ in events_in(self.connected().taken())])

    def test_read_what_changed_only(self) -> None:
        """While the version is unchanged, the state is read once per second; a new version is sent immediately."""
        self.version = 1
        page = self.connected()
        reads = self.reads
        self.clock.pump([0.1] * 30)
        self.assertIn(self.reads - reads, (2, 3))
        page.taken()
        self.state["n"], self.version = 1, 2
        self.clock.advance(0.1)
        self.assertIn(("change", {"n": 1}), events_in(page.taken()))

    def test_keep_the_event_log_without_a_page(self) -> None:
        """Between ``start`` and ``close`` the event log receives the state every second, even if no page is open."""
        self.events.start()
        self.clock.pump([0.5] * 6)
        self.assertEqual(self.reads, 3)
        self.events.close()
        self.assertEqual(self.clock.getDelayedCalls(), [])

    def test_limit_pace(self) -> None:
        """A page receives at most ten changes per second, in order."""
        page = self.connected()
        page.taken()
        for n in range(1, 101):
            self.state["n"] = n
            self.clock.advance(0.01)
        told = [words["n"] for name, words in events_in(page.taken()) if name == "change"]
        self.assertLessEqual(len(told), 10)
        self.assertGreaterEqual(len(told), 9)
        self.assertEqual(told, sorted(told))

    def test_put_off_slow_pages(self) -> None:
        """A page that does not read its stream receives nothing.

        When the page reads again, it receives the missed changes and their number.
        """
        self.state["more"] = MORE
        slow, quick = self.connected(), self.connected()
        slow.taken()
        slow.pause()
        for n in range(1, 6):
            self.state["n"] = n
            self.clock.advance(0.1)
        self.assertEqual(slow.taken(), b"")
        self.assertIn(("change", {"n": 5}), events_in(quick.taken()))
        slow.resume()
        self.clock.pump([0.1] * 6)
        told = events_in(slow.taken())
        self.assertEqual([words["n"] for name, words in told if name == "change"], [1, 2, 3, 4, 5])
        self.assertGreaterEqual([words for name, words in told if name == "beat"][-1]["skipped"], 5)

    def test_spare_slow_pages_the_past(self) -> None:
        """A page that has missed too many changes, or more data than the state, receives the state as a resync."""
        for more, missed in ((MORE, MAX_CHANGES + 2), ("", 4)):
            self.state.update({"more": more, "n": 0})
            slow = self.connected()
            slow.taken()
            slow.pause()
            for n in range(1, missed + 1):
                self.state["n"] = n
                self.clock.advance(0.1)
            slow.resume()
            self.clock.advance(0.1)
            told = [event for event in events_in(slow.taken()) if event[0] in ("state", "change")]
            self.assertEqual(told, [("state", {"resync": True, "n": missed, "more": more})])

    def test_rest_when_nobody_looks(self) -> None:
        """If no page is open, nothing is read and no timer remains."""
        pages = [self.connected(), self.connected()]
        for page in pages:
            page.leave()
        reads = self.reads
        self.assertEqual((self.clock.getDelayedCalls(), self.events.viewers), ([], 0))
        self.clock.advance(5)
        self.assertEqual(self.reads, reads)

    def test_live_through_failures(self) -> None:
        """A state that cannot be serialized ends no stream, and is logged once."""
        page = self.connected()
        page.taken()
        self.state["n"] = float("nan")
        self.clock.pump([0.1] * 6)
        self.assertEqual({name for name, _ in events_in(page.taken())}, {"beat"})
        self.assertEqual(len(self.flushLoggedErrors(ValueError)), 1)
        self.state["n"] = 2
        self.clock.advance(0.1)
        self.assertIn(("change", {"n": 2}), events_in(page.taken()))

    def test_cap_pages(self) -> None:
        """A page beyond ``MAX_VIEWERS`` gets status 503."""
        for _ in range(MAX_VIEWERS):
            self.connected()
        self.assertIn(b" 503 ", self.connected().taken())
        self.assertEqual(self.events.viewers, MAX_VIEWERS)

    def test_close(self) -> None:
        """``close`` ends every stream, and no timer remains."""
        page = self.connected()
        self.events.close()
        self.assertTrue(page.taken().endswith(b"0\r\n\r\n"))
        self.assertEqual(self.clock.getDelayedCalls(), [])


def blind(uuid: str, on_frame: OnFrame) -> Callable[[], None]:
    """Refuse to watch, because no device has a camera."""
    raise Refusal("device", "it has no camera", "choose another", 404)


class CameraImagesTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.clock = Clock()
        self.frames = MemoryFrames()
        self.images = CameraImages(self.frames.watch, self.clock)
        self.site = self.site_with(self.images)

    def site_with(self, images: CameraImages) -> Any:
        root = Resource()
        root.putChild(b"shot", images)
        return site_of(root, self.clock)

    def asked(self, after: str = "", viewer: str = "") -> Connection:
        return Connection(self.site).ask(f"/shot/ab?after={after}&viewer={viewer}")

    def test_wait_for_the_next(self) -> None:
        """A request waits for the next picture; the response contains the picture and its number."""
        page = self.asked()
        self.assertEqual(page.taken(), b"")
        self.frames.show("ab", 7, JPEG)
        data = page.taken()
        self.assertIn(b"X-Seq: 7", data)
        self.assertIn(b"image/jpeg", data)
        self.assertTrue(data.endswith(JPEG))

    def test_answer_with_the_newest(self) -> None:
        """A request receives the newest picture immediately, with its age, but not a picture that it already has."""
        self.asked()
        for seq in (1, 2, 3):
            self.frames.show("ab", seq, JPEG, 0.5)
        self.clock.advance(0.25)
        data = self.asked("1").taken()
        self.assertIn(b"X-Seq: 3", data)
        self.assertIn(b"X-Age: 0.750", data)
        self.assertEqual(self.asked("3").taken(), b"")

    def test_take_a_lower_number_for_new(self) -> None:
        """A picture with a lower number is treated as new, because a restarted camera counts from one."""
        page = self.asked("900")
        self.frames.show("ab", 1, JPEG)
        self.assertIn(b"X-Seq: 1", page.taken())

    def test_give_up_after_five_seconds(self) -> None:
        """Without a picture the response after five seconds is 204, so the page knows that the node is running."""
        page = self.asked()
        self.clock.advance(4.9)
        self.assertEqual(page.taken(), b"")
        self.clock.advance(0.1)
        self.assertIn(b" 204 ", page.taken())

    def test_open_a_silent_upstream_anew(self) -> None:
        """While requests wait, a silent upstream is opened again, because the device can have a new address."""
        self.asked()
        self.clock.advance(5)
        page = self.asked()
        self.frames.watched["ab"](1, JPEG, 0.0)
        self.assertIn(b" 200 ", page.taken())
        self.assertEqual(self.frames.opened, 2)

    def test_hold_one_question_a_viewer(self) -> None:
        """A new request of a viewer ends the viewer's older request with status 204; other viewers are not affected."""
        first, other = self.asked(viewer="a"), self.asked(viewer="b")
        second = self.asked(viewer="a")
        self.assertIn(b" 204 ", first.taken())
        self.frames.show("ab", 1, JPEG)
        self.assertIn(b" 200 ", second.taken())
        self.assertIn(b" 200 ", other.taken())

    def test_watch_only_while_somebody_looks(self) -> None:
        """The upstream starts with the first request and stops two seconds after the last request; no timer remains."""
        self.assertEqual(list(self.frames.watched), [])
        page = self.asked(viewer="a")
        again = self.asked(viewer="a")
        self.clock.advance(4)
        self.assertEqual(list(self.frames.watched), ["ab"])
        self.frames.show("ab", 1, JPEG)
        self.clock.advance(1.9)
        self.assertEqual(list(self.frames.watched), ["ab"])
        self.clock.advance(0.2)
        self.assertEqual((list(self.frames.watched), self.images.watched), ([], []))
        self.assertEqual(self.clock.getDelayedCalls(), [])
        self.assertTrue(page.taken() and again.taken())

    def test_forget_who_left(self) -> None:
        """A viewer that closes its connection is removed."""
        page = self.asked()
        page.leave()
        self.frames.show("ab", 1, JPEG)
        self.clock.advance(2)
        self.assertEqual((page.taken(), self.images.watched), (b"", []))

    def test_drop_what_is_no_picture(self) -> None:
        """Incomplete or oversized JPEG data, and pictures with too many pixels, are dropped."""
        page = self.asked()
        self.frames.show("ab", 1, b"<script>")
        self.frames.show("ab", 2, JPEG[:-2] + bytes(2_000_000) + JPEG[-2:])
        self.frames.show("ab", 3, JPEG[:-1])
        self.frames.show("ab", 4, jpeg(65500, 65500))
        self.assertEqual(page.taken(), b"")

    def test_tell_of_no_camera(self) -> None:
        """A request to a device without a camera gets status 404 and leaves no state."""
        images = CameraImages(blind, self.clock)
        data = Connection(self.site_with(images)).ask("/shot/cd?after=").taken()
        self.assertIn(b" 404 ", data)
        self.assertIn(b"it has no camera", data)
        self.assertEqual(images.watched, [])

    def test_cap_waiting(self) -> None:
        """A request beyond ``MAX_WAITING`` gets status 503."""
        for _ in range(MAX_WAITING):
            self.asked()
        self.assertIn(b" 503 ", self.asked().taken())

    def test_ignore_late_pictures(self) -> None:
        """A picture that arrives after the upstream has stopped has no effect."""
        self.asked()
        late = self.frames.watched["ab"]
        self.images.close()
        late(1, JPEG, 0.0)
        self.assertEqual((self.clock.getDelayedCalls(), self.images.watched), ([], []))

    def test_close(self) -> None:
        """``close`` ends waiting requests with a response, and stops the upstream."""
        page = self.asked()
        self.images.close()
        self.assertIn(b" 204 ", page.taken())
        self.assertEqual((list(self.frames.watched), self.clock.getDelayedCalls()), ([], []))
