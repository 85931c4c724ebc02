"""Parts of a web node in memory, for tests of routes, pages and servers without a team."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from twisted.internet.defer import Deferred, fail, succeed

from middleware.config.tuning import INVALID_SETTING
from middleware.entangled.errors import Refused
from webnode.camera import OnFrame
from webnode.diagnostics import Diagnostics
from webnode.errors import Refusal
from webnode.faults import FaultControl
from webnode.invite import Invites
from webnode.sanitize import Json
from webnode.services import PictureReply
from webnode.stop_control import StopControl
from webnode.team_control import TeamControl


class MemoryDiagnostics(Diagnostics):
    """Diagnostics that return fixed results for the network, each device, the links and the team."""

    def __init__(self, network: Json, inventories: Mapping[str, Json], links: Json = None, team: Json = None) -> None:
        self._network = network
        self._inventories = inventories
        self._links = links
        self._team = team

    def query_network(self) -> Deferred[Json]:
        """Return the network."""
        return succeed(self._network)

    def query_links(self) -> Deferred[Json]:
        """Return the links."""
        return succeed(self._links)

    def describe_team(self) -> Json:
        """Return the team."""
        return self._team

    def query_inventory(self, uuid: str) -> Deferred[Json]:
        """Return the inventory, or fail with status 504 for a device that does not reply."""
        if uuid not in self._inventories:
            return fail(Refusal("device", "it did not answer", "wait a moment, then try again", 504))
        return succeed(self._inventories[uuid])


class MemoryStopControl(StopControl):
    """The emergency stop of a team that always obeys.

    ``devices`` contains the uuids of the devices, ``said`` the received requests.
    """

    def __init__(self, *devices: str) -> None:
        self.devices = devices
        self.said: list[tuple[str, str]] = []

    def stop(self, by: str) -> Deferred[dict[str, str]]:
        """Record a stop."""
        self.said.append(("halt", by))
        return succeed(dict.fromkeys(self.devices, "stands"))

    def release(self, by: str, stops: Sequence[str] | None = None) -> Deferred[dict[str, str]]:
        """Record a release."""
        self.said.append(("release", by))
        return succeed(dict.fromkeys(self.devices, "goes on"))

    def is_halted(self) -> bool:
        """Return whether the last request was a stop."""
        return bool(self.said) and self.said[-1][0] == "halt"


class MemoryFaults(FaultControl):
    """Fault control that only records faults.

    ``injected`` contains (uuid, kind, seconds, amount), ``rows`` the active faults.
    """

    def __init__(self, *kinds: str) -> None:
        self.injected: list[tuple[str, str, float, float | None]] = []
        self.rows: list[dict[str, Json]] = []
        self._allowed = kinds

    def get_kinds(self, uuid: str) -> Sequence[str]:
        """Return the given kinds."""
        return self._allowed

    def inject(self, uuid: str, kind: str, seconds: float, amount: float | None) -> Deferred[None]:
        """Record the fault; it has no effect."""
        self.injected.append((uuid, kind, seconds, amount))
        row: dict[str, Json] = {
            "n": len(self.injected),
            "uuid": uuid,
            "name": uuid[:4],
            "kind": kind,
            "amount": amount,
            "left_s": seconds,
        }
        self.rows.insert(0, {**row, "task": "t1", "since_s": 0.0, "takeover_s": None, "to": "", "watched": True})
        return succeed(None)

    def list_active(self) -> list[dict[str, Json]]:
        """Return the recorded faults, newest first."""
        return self.rows


class MemoryPhones:
    """Phones that are only recorded: ``registered`` maps uuids to names, ``pictures`` has (uuid, bytes, values).

    ``check`` raises ``Refusal`` for data that is not a picture.
    """

    def __init__(self, max_phones: int = 8, check: Callable[[bytes], object] = lambda jpeg: None) -> None:
        self.registered: dict[str, str] = {}
        self.pictures: list[tuple[str, bytes, Mapping[str, float]]] = []
        self.can: Mapping[str, Any] = {}
        self._max_phones = max_phones
        self._check = check

    def join(self, secret: bytes, name: str, can: Mapping[str, Any]) -> Deferred[str]:
        """Add the phone; its uuid is the end of its secret."""
        uuid = secret[-20:].hex()
        if uuid not in self.registered and len(self.registered) >= self._max_phones:
            return fail(Refusal("phone", "too many take part", "wait until one leaves", 409))
        self.registered[uuid], self.can = name, can
        return succeed(uuid)

    def receive_picture(self, uuid: str, jpeg: bytes, values: Mapping[str, float]) -> PictureReply:
        """Record the picture."""
        self._check(jpeg)
        if uuid not in self.registered:
            raise Refusal("uuid", "this phone has not joined here", "join with POST /api/v1/phones", 404)
        self.pictures.append((uuid, jpeg, values))
        return PictureReply(10.0, "Look for the red target: turn slowly.")

    def leave(self, uuid: str) -> None:
        """Remove the phone."""
        self.registered.pop(uuid, None)

    def close(self) -> Deferred[Any]:
        """Remove all phones."""
        self.registered.clear()
        return succeed(None)


class MemoryInvites(Invites):
    """Invitations with given pages; a QR code contains only its text."""

    def __init__(self, *urls: str, authority: bytes = b"", fingerprint: str = "") -> None:
        self.pages = list(urls)
        self.authority = authority
        self.fingerprint = fingerprint

    def urls(self) -> list[str]:
        """Return the pages."""
        return self.pages

    def draw_qr_code(self, text: str) -> Deferred[str]:
        """Return an empty picture with the title ``text``, or nothing for an empty text."""
        if not text:
            return succeed("")
        title = text.replace("&", "&amp;").replace("<", "&lt;")
        return succeed(f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 9 9"><title>{title}</title></svg>')


class MemoryFrames:
    """A frame source in memory: ``show`` delivers a picture; ``watched`` contains the watched devices."""

    def __init__(self) -> None:
        self.watched: dict[str, OnFrame] = {}
        self.opened = 0

    def watch(self, uuid: str, on_frame: OnFrame) -> Callable[[], None]:
        """Watch ``uuid``; every device in this fake has a camera."""
        self.watched[uuid] = on_frame
        self.opened += 1
        return lambda: self.watched.pop(uuid, None) and None

    def show(self, uuid: str, seq: int, jpeg: bytes, age: float = 0.0) -> None:
        """Deliver a picture if the device is watched."""
        if uuid in self.watched:
            self.watched[uuid](seq, jpeg, age)


class MemoryTeamControl(TeamControl):
    """A team control that records each request in ``asked``, and has a small map."""

    def __init__(self, catalogue: Sequence[Mapping[str, Any]] = (), robot_map: Mapping[str, Any] | None = None) -> None:
        self.asked: list[tuple[Any, ...]] = []
        self.tasks = list(catalogue)
        self.previews: dict[str, dict[str, Any]] = {}
        self.together: dict[str, list[dict[str, Any]]] = {}
        self.map: dict[str, Any] | None = dict(robot_map) if robot_map is not None else None
        self.settings: dict[str, list[list[Any]]] = {}
        self.frames: Any = MemoryFrames()

    def stream_camera(self, uuid: str, on_frame: OnFrame) -> Callable[[], None]:
        """Watch ``frames``."""
        stop: Callable[[], None] = self.frames.watch(uuid, on_frame)
        return stop

    def call(
        self,
        uuid: str,
        method: str,
        *arguments: Any,
        refused: Callable[[Refused], Refusal | None] = lambda refused: None,
    ) -> Deferred[Any]:
        """Apply the changes to ``settings`` and return the rows of the device; fail for an unknown setting."""
        rows = self.settings.get(uuid, [])
        for changes in arguments:
            for key, value in changes.items():
                row = next((row for row in rows if row[0] == key), None)
                if row is None:
                    error = Refused(f"{key}: cannot be changed on this device; leave it out", INVALID_SETTING)
                    return fail(refused(error) or error)
                row[1] = value
        return succeed(rows)

    def run_demo(self, task_id: str = "") -> str:
        """Return ``demo-N``, or the given id."""
        recorded = self._record("demo")
        return task_id or recorded

    def assign(self, name: str, tolerates: int = 1, group: str = "", task_id: str = "") -> dict[str, Any]:
        """Return ``assign-N``, or the given id, with empty lists of able and refused devices."""
        if name not in [task["name"] for task in self.tasks]:
            raise Refusal("name", f"there is no task {name!r}", "choose one of /api/v1/catalogue", 404)
        recorded = self._record("assign", name)
        return {"id": task_id or recorded, "able": [], "refused": {}}

    def preview(self, name: str, group: str = "") -> dict[str, Any]:
        """Return the entry of ``previews``, or a result with empty lists of able and refused devices."""
        if name not in [task["name"] for task in self.tasks]:
            raise Refusal("name", f"there is no task {name!r}", "choose one of /api/v1/catalogue", 404)
        entry = self.previews.get(name, {"able": [], "refused": {}, "likely": None})
        return {**entry, "together": self.together.get(group, [])}

    def list_predefined(self) -> list[Mapping[str, Any]]:
        """Return the given catalogue."""
        return self.tasks

    def cancel(self, task_id: str) -> None:
        """Record the request."""
        self._record("cancel", task_id)

    def pause(self, task_id: str) -> None:
        """Record the request."""
        self._record("pause", task_id)

    def resume(self, task_id: str) -> None:
        """Record the request."""
        self._record("resume", task_id)

    def send_message(self, uuid: str, text: str) -> Deferred[dict[str, Any]]:
        """Record the request; the message is delivered to no device."""
        self._record("message", uuid, text)
        return succeed({"delivered": [], "failed": {}})

    def disconnect(self, uuid: str, seconds: float) -> Deferred[Any]:
        """Record the request."""
        return succeed(self._record("disconnect", uuid, seconds))

    def move_target(self, x: float, y: float) -> Deferred[bool]:
        """Move the target."""
        self._change(target={"x": x, "y": y, "radius": 0.08})
        return succeed(bool(self._record("target", x, y)))

    def clear_target(self) -> Deferred[bool]:
        """Remove the target."""
        self._change(target=None)
        return succeed(bool(self._record("clear")))

    def move_robot(self, name: str, x: float, y: float, heading: float) -> Deferred[bool]:
        """Move the robot."""
        place = {"x": x, "y": y, "heading": heading}
        if self.map is not None:
            self._change(dogs=[{**dog, **place} if dog["name"] == name else dog for dog in self.map["dogs"]])
        return succeed(bool(self._record("robot", name, x, y, heading)))

    def _change(self, **changes: Any) -> None:
        if self.map is not None:
            self.map = {**self.map, **changes}

    def get_map(self) -> dict[str, Any] | None:
        """Return the map."""
        return self.map

    def _record(self, *request: Any) -> str:
        self.asked.append(request)
        return f"{request[0]}-{len(self.asked)}"
