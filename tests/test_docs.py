"""The documents: what they point to exists, and the examples are lawful settings."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from pathlib import Path
from random import Random

from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase

from agents import body, engagement, guarded, loop, means
from agents.catalogue import TASKS
from drivers import conformance
from drivers.aibo.option import PORTS
from drivers.compass.option import PORT as COMPASS_PORT
from drivers.create2.codec import FRAME_S as STREAM_S
from drivers.deadman import keeper, process
from drivers.errors import UsageError
from drivers.phone import driver, option
from drivers.registry import built_in_kinds, describe
from formats.head import MAX_HEAD
from middleware.config.settings import Settings
from middleware.consensus import guard, strategy, worker
from middleware.consensus.bidding import check, party, scale, teller, tree
from middleware.consensus.lease import lease_codec, lessee
from middleware.deployment import confinement, deployment, frame, manifest, module, runner
from middleware.diagnostics import survey
from middleware.entangled.control import health, port
from middleware.entangled.kademlia import detour, membership, roster
from middleware.entangled.network import bundle, link, tcp, tunnel, websocket
from middleware.entangled.replication import handover, pusher, replica, subscriber
from middleware.entangled.space import shelf, template
from middleware.entangled.wire import rebuff
from middleware.faults import kinds, takeover
from middleware.stop import halt, stop_set
from sim.demo.cast import CASTS
from sim.demo.configuration import DOGS
from sim.robots import dog, scene, sensor, world
from sim.robots.crowd import crowd, ray
from sim.robots.emulator import aibo_dog, rosbridge
from sim.robots.table import Robots, emulated_kinds
from sim.robots.yard import Yard
from swarmnode import gateway
from swarmnode.driver import pilot
from tests.layers import write_table
from tests.role_table import write_tables
from webnode import channel, limits, live, team
from webnode.audit import AUDITED
from webnode.routes import devices, phones

ROOT = Path(__file__).parents[1]
DOCUMENTS = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").rglob("*.md")),
    ROOT / "benchmarks" / "README.md",
]
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
NAMED = re.compile(r"`([\w./-]+\.(?:py|toml|json|md))(?:::(\w+))?`")
EXAMPLES = sorted((ROOT / "examples").glob("*.toml"))
FIGURES: Sequence[tuple[str, str]] = (
    ("simulator", f"until somebody has gone {50 * ray.SKIN:g} cm"),
    ("simulator", f"overlaps by more than {1000 * crowd.SLOP:g} mm"),
    ("simulator", f"Steps are of {1000 * world.TICK:g} ms"),
    ("agents", f"one turn each {1000 * loop.TICK:g} ms"),
    ("agents", f"its battery is empty (below {body.EMPTY:g} where it tells its level)"),
    ("agents", f"the simulated dog | {means.WALK:g} m/s"),
    ("agents", f"| {means.SWIFT:g} m/s, or its own limit"),
    ("agents", f"| {means.STOP_AT:g} m before its head"),
    ("agents", f"the first at once, the second {lessee.STAGGER:g} s later"),
    ("consensus", f"Each rank waits {lessee.STAGGER:g} s longer than the one before it"),
    ("consensus", f"News of a release is believed for {lessee.FRESH:g} s"),
    ("consensus", f"*sending* + ttl x {1.0 - lessee.CLOCK_MARGIN:g}"),
    ("consensus", f"the lowest {lease_codec.LIFE.bit_length() - 1} bits of the counter"),
    ("consensus", f"go to its post, for {engagement.SEARCH_TTL:g} s at a time"),
    ("consensus", f"enormous (above {strategy.MAX_NUMBER:.0e})".replace("e+0", "e")),
    ("consensus", f"a process of their own with {worker.DEADLINE_S:g} s for each answer"),
    ("consensus", f"answers more than {worker.MAX_ANSWER // 1024} KiB"),
    ("consensus", f"after three times in {guard.SPAN:,} questions"),
    ("consensus", f"| 1 to {scale.MOST_DIRECT} | each bidder tells"),
    ("consensus", f"| {scale.MOST_DIRECT + 1} and more (back below {scale.LEAST_TREE}) |"),
    ("consensus", f"waits {1000 * tree.HOLD_PER_BIT:g} ms for each bit"),
    ("consensus", f"after {teller.STAND_IN:g} s each the next one stands in"),
    ("consensus", f"told nothing {check.SILENCE:g} s after the waiting period asks"),
    ("consensus", f"for all behind it after {party.RELAY_SILENCE:g} s"),
    ("demo", f"an AIBO walks on until {aibo_dog.DEAD_MAN_S:g} s after its last command"),
    ("deployment", f"the source has at most {manifest.MAX_SOURCE // 1024} KiB"),
    ("deployment", f"takes at most {module.STEPS:,} instructions"),
    ("deployment", f"seccomp: {len(confinement.CALLS)} system calls"),
    ("deployment", f"{confinement.MEMORY // 2**20} MiB beside its libraries; {confinement.CPU_S} s"),
    ("deployment", f"does not answer within {runner.DEADLINE_S:g} s"),
    ("deployment", f"answer is older than {guarded.FRESH_S:g} s"),
    ("deployment", f"does not answer within {runner.PATIENCE_S:g} s, raises"),
    ("deployment", f"an answer has more than {frame.MAX_ANSWER // 1024} KiB"),
    ("deployment", f"nobody has asked it for {deployment.IDLE_S:g} s"),
    ("drivers", f"in every state, at rest within {conformance.HALT_S:g} s"),
    ("drivers", f"While driving a key counts for {pilot.KEY_S:g} s"),
    ("faults", f"Seconds are {kinds.MIN_S:g} to {kinds.MAX_S:g}, {kinds.USUAL_S:g} where"),
    ("faults", f"later than {takeover.TARGET_S:g} s, or nobody took over"),
    ("faults", f"below {body.EMPTY:g} its agent takes its report back"),
    ("library", f"After about {membership.SILENCE + roster.STRUCK_S:g} s the absent are struck"),
    ("library", f"A request has at most {port.MAX_REQUEST:,} bytes, a node {port.MAX_CONNECTIONS} connections"),
    ("phone", f"says nothing for {gateway.SILENCE_S:g} s has gone as well"),
    ("phone", f"from {driver.PhoneDriver.STALE_S:g} s on it counts as silent"),
    ("phone", f"| {gateway.MOST}: each is a node"),
    ("phone", f"| {option.FPS:g} a second wanted while it has a task, {gateway.IDLE_FPS:g} else"),
    ("phone", f"more than {gateway.LOOKS_S:g} a second ({gateway.LOOKS:g} at once)"),
    ("phone", f"at most {phones.MOST_SIDE} pixels a side"),
    ("phone", f"no others, {phones.TICKET_S / 3600:g} hours"),
    ("phone", f"{option.LENS_DEG:g} degrees across the longer side"),
    ("phone", f"keeps it in view for {TASKS['watch-target'].parameters['seconds']:g} s in all"),
    ("phone", f"in view for {TASKS['watch-target'].stall_limit:g} s gives the task to another"),
    ("protocol", f"gone on without it for {roster.STRUCK_S:g} s, or for {roster.COUNTED_S:g} s"),
    ("protocol", f"out of touch with a majority for {handover.OUT_OF_TOUCH:g} s"),
    ("protocol", f"Pages hold about {replica.PAGE_BYTES:,} bytes"),
    ("protocol", f"counts for {pusher.WATCH_TTL:g} s and is asked again every {subscriber.RENEW:g} s"),
    ("robots/stopping", f"switch, {process.GRACE_S:g} s after the deadline"),
    ("robots/stopping", f"again after {process.AGAIN_S:g} and {(process.TIMES - 1) * process.AGAIN_S:g} s"),
    ("robots/stopping", f"another one is started after {keeper.FIRST_WAIT_S:g} s"),
    ("robots/stopping", f"it wakes {1 / process.TICK_S:g} times a second"),
    ("robots/stopping", f"tried again, every {keeper.LAST_WAIT_S:g} s at last"),
    ("safety", f"halts the robot: {process.GRACE_S:g} s after the deadline, or at once"),
    ("safety", f"AIBO {aibo_dog.DEAD_MAN_S:g} s, most ROS bases {rosbridge.BASE_STOPS_S:g} s"),
    ("safety", f"the head of a request | {channel.HEAD_S:g} s after its first byte"),
    ("safety", f"less than {channel.PACE / 1000:g} kB/s on the average after {channel.GRACE_S:g} s"),
    ("safety", f"that has had an answer | {channel.KEEP_S:g} s"),
    ("safety", f"nothing is taken | {channel.STALL_S:g} s"),
    ("safety", f"does not hang up | {channel.CLOSE_S:g} s"),
    (
        "safety",
        f"{limits.MOST['unfinished']} requests that are not complete, {limits.MOST['stream']} answers under way",
    ),
    ("safety", f"and {limits.MOST['open']} connections"),
    ("safety", f"the newest {AUDITED} in memory"),
    ("simulator", f"Physics in steps of {1000 * world.SUBSTEP:g} ms"),
    ("simulator", f"a battery of {sensor.BATTERY_S / 60:g} minutes"),
    ("simulator", f"a circle of {200 * scene.FOOTPRINT:g} cm that weighs {dog.MASS:g} kg"),
    ("robots/aibo", f"TCP {PORTS['main']} (main control), {PORTS['estop']} (e-stop)"),
    (
        "robots/aibo",
        f"{PORTS['state']} (world state), {PORTS['walk']} (walk), {PORTS['head']} (head), {PORTS['camera']}",
    ),
    (
        "robots/aibo",
        f"a world state each {1000 * aibo_dog.FRAME_S:g} ms, pictures up to {1 / aibo_dog.CAMERA_S:g} a second",
    ),
    ("robots/aibo", f"Walks on for {aibo_dog.DEAD_MAN_S:g} s after the last command"),
    ("robots/create2", f"the stream each {1000 * STREAM_S:g} ms"),
    ("robots/rosbridge", f"stands after {rosbridge.BASE_STOPS_S:g} s without"),
    (
        "robots/rosbridge",
        f"`/imu` {rosbridge.TOPICS['/imu'][1]:g} times a second, `/scan` {rosbridge.TOPICS['/scan'][1]:g}",
    ),
    (
        "robots/rosbridge",
        f"`/camera/image_raw/compressed` {rosbridge.TOPICS['/camera/image_raw/compressed'][1]:g} times",
    ),
    ("simulator", f"Of the scanner's {rosbridge.BEAMS} beams"),
    ("robots/compass", f"TCP {COMPASS_PORT} or `port`"),
    ("tuplespace", f"1 to {template.MAX_FIELDS} fields"),
    ("tuplespace", f"asked every {shelf.POLL:g} s whether"),
    ("tunnel", f"no known node has answered by UDP for {detour.AFTER_S:g} s"),
    ("tunnel", "by UDP after {:g}, {:g} and then every {:g} s".format(*detour.AGAIN_S)),
    ("tunnel", f"carried nothing for {tunnel.UNUSED_S:g} s"),
    ("tunnel", f"at most {tunnel.LAST_HOLD_S:g} s |"),
    ("tunnel", f"datagrams of up to {link.SHORT} bytes"),
    ("tunnel", f"{link.MAX_SENDING // 1024} KiB of these in the transport"),
    ("tunnel", f"hold back no more than {tcp.UNSENT // 1024} KiB"),
    ("tunnel", f"after {link.IDLE_S:g} s without a sign of the other end, or {link.QUIET_S:g} s when"),
    ("tunnel", f"does not answer within {link.PONG_S:g} s"),
    ("tunnel", f"takes nothing for {link.STALL_S:g} s"),
    ("tunnel", f"| {tunnel.HEAD_S:g} s from the connection on, and {MAX_HEAD // 1024} KiB of head"),
    ("tunnel", f"got nothing through for {bundle.STILL_S:g} s"),
    ("tunnel", f"until {bundle.ROUGH_S:g} s after that"),
    ("tunnel", f"stands still for {bundle.DEAD_S:g} s while another moves"),
    ("tunnel", f"takes no more than {bundle.HELD // 1024} KiB"),
    ("tunnel", f"none opens within {bundle.OPENING_S:g} s"),
    ("tunnel", f"| {bundle.MOST * tunnel.MAX_OF_HOST}, three for each of {tunnel.MAX_OF_HOST} tunnels"),
    ("tunnel", f"| {tunnel.MAX_BEGUN}; the oldest makes room"),
    ("tunnel", f"| {tunnel.MAX_OF_HOST}; behind a reverse proxy"),
    ("tunnel", f"| {tunnel.MAX_LINKS}; strangers make room"),
    ("tunnel", f"| {tunnel.UNANSWERED_S:g} s: the wire answers nobody"),
    ("tunnel", f"| {websocket.MAX_PAYLOAD} bytes; what breaks"),
    ("actions", f"after {team.PATIENCE:g} s at the latest"),
    ("actions", f"place the target, {team.PLACING:g} s later"),
    ("protocol", f"at most {stop_set.MAX_NAMED} stops `[id, by]`, at most {stop_set.MAX_RELEASED} ids of stops"),
    ("protocol", f"by: at most {stop_set.MAX_BY} characters; an id has {stop_set.ID_BYTES} bytes"),
    ("protocol", f"the newest {halt.RECORDED_RELEASES} ids that it released"),
    ("web", f"`text`, 1 to {devices.MAX_MESSAGE} characters"),
    ("web", f"`seconds`, {devices.MIN_AWAY_S:g} to {devices.MAX_AWAY_S:g}, default {devices.AWAY_S:g}"),
    ("web", f"At most {live.MAX_VIEWERS} streams"),
    ("web", f"nobody has asked for {health.IDLE:g} s"),
    ("web", f"those with {survey.ENDING_S / 86_400:g} days or less come first"),
    ("web", f"A node keeps the last {rebuff.MAX_REBUFFS}, in memory"),
)
"""What a document says with a figure of the code in it."""


def part_of(document: Path, title: str) -> str:
    """What stands below the heading ``title``, down to the next one."""
    parts = document.read_text(encoding="utf-8").split("\n## ")
    (found,) = (part for part in parts if part.splitlines()[0] == title)
    return found


class DocumentTests(SynchronousTestCase):
    def test_links_lead_somewhere(self) -> None:
        """Every relative link and picture of the documents is a file or folder beside them."""
        for document in DOCUMENTS:
            for target in LINK.findall(document.read_text(encoding="utf-8")):
                if not re.match(r"https?:|mailto:|#", target):
                    place = document.parent / target.partition("#")[0]
                    self.assertTrue(place.exists(), f"{document.relative_to(ROOT)} links to {target}")

    def test_named_files_exist(self) -> None:
        """Every file that a document names by its path exists, and holds the name that stands behind it."""
        for document in DOCUMENTS:
            for path, name in NAMED.findall(document.read_text(encoding="utf-8")):
                if "/" not in path and not name:
                    continue
                where = f"{document.relative_to(ROOT)} names {path}"
                self.assertTrue((ROOT / path).is_file(), where)
                if name:
                    defined = rf"^\s*(?:async )?(?:def|class) {name}\b|^(?:[A-Z_]+, )*{name}\b[^=\n]*="
                    text = (ROOT / path).read_text(encoding="utf-8")
                    self.assertTrue(re.search(defined, text, re.MULTILINE), f"{where}::{name}")

    def test_figures_are_those_of_the_code(self) -> None:
        """Seconds, bytes and numbers that a document takes from a constant are those that the constant has now."""
        for name, said in FIGURES:
            text = " ".join((ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8").split())
            self.assertTrue(said in text, f"docs/{name}.md does not say: {said}")

    def test_role_tables_are_those_of_the_code(self) -> None:
        """The tables of roles on the security page are made from the role table."""
        self.assertIn(write_tables(), (ROOT / "docs" / "security.md").read_text(encoding="utf-8"))

    def test_layers_are_those_of_the_tests(self) -> None:
        """The table of packages on the architecture page is made from the layers that the tests hold."""
        self.assertIn(write_table(), (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8"))

    def test_every_robot_is_listed(self) -> None:
        """The table of robots in the README has each kind of driver and no other, and leads to its page."""
        table = part_of(ROOT / "README.md", "Robots")
        rows = re.findall(r"^\| `(\w+)` \|.*\[\w+\.md\]\(docs/([\w./]+)\) \|$", table, re.MULTILINE)
        self.assertEqual(sorted(kind for kind, _ in rows), built_in_kinds())
        for kind, page in rows:
            self.assertIn(f"`{kind}`", (ROOT / "docs" / page).read_text(encoding="utf-8"))

    def test_every_cast_is_listed(self) -> None:
        """The demonstration's page and ``make help`` name each choice of ROBOT and no other, and the same default."""
        rows = re.findall(r"^\| `(\w+)`", part_of(ROOT / "docs" / "demo.md", "Which robots"), re.MULTILINE)
        self.assertEqual(sorted(rows), sorted(CASTS))
        makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
        self.assertIn(f"[ROBOT={'|'.join(sorted(CASTS))}]", makefile)
        (default,) = re.findall(r"^ROBOT +\?= (\w+)$", makefile, re.MULTILINE)
        self.assertIn(f"| `{default}` (default) |", part_of(ROOT / "docs" / "demo.md", "Which robots"))

    def test_emulators_serve_the_tables_of_their_pages(self) -> None:
        """The page of each kind that has an emulator shows a table that the yard takes; so does the yard's own page."""
        clock = Clock()
        for page in ("simulator", *(f"robots/{kind}" for kind in emulated_kinds())):
            played: set[str] = set()
            text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
            for block in re.findall(r"^```toml\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
                table = tomllib.loads(block)
                if not set(table) <= set(DOGS):
                    continue
                Robots(clock, Random(1), Yard(clock, Random(1), scene.loaded("three-dogs")), table)
                for robot in table.values():
                    played |= {robot["kind"], *(part["kind"] for part in robot.get("parts", []))}
            self.assertIn("create2" if page == "simulator" else page.removeprefix("robots/"), played)
        with self.assertRaises(UsageError) as refused:
            Robots(clock, Random(1), Yard(clock, Random(1), scene.loaded("three-dogs")), {"dog1": {"kind": "phone"}})
        self.assertTrue(str(refused.exception).endswith(f"it has {', '.join(emulated_kinds())}"), refused.exception)

    def test_thesis_is_complete(self) -> None:
        """The page on the thesis has a row for each requirement, assumption and algorithm, and Figures 5.3 to 5.7."""
        text = (ROOT / "docs" / "thesis.md").read_text(encoding="utf-8")
        chapters = {part.splitlines()[0].split(" ")[0]: part for part in text.split("\n## ")[1:]}
        for chapter, numbers in (("Requirements", range(1, 10)), ("Assumptions", range(1, 6))):
            for number in numbers:
                self.assertIn(f"\n| {number} | ", chapters[chapter])
        for number in range(1, 6):
            self.assertIn(f"\n| 4.{number} | ", chapters["Algorithms"])
        for number in range(3, 8):
            self.assertIn(f"(images/figure-5-{number}.png)", chapters["Figures"])

    def test_pictures_are_light(self) -> None:
        """No picture of the documents weighs more than 300 kB, and each is shown somewhere."""
        shown = " ".join(document.read_text(encoding="utf-8") for document in DOCUMENTS)
        for picture in sorted((ROOT / "docs" / "images").glob("*.png")):
            self.assertLess(picture.stat().st_size, 300_000, picture.name)
            self.assertTrue(f"images/{picture.name}" in shown, f"no document shows {picture.name}")


class ExampleTests(SynchronousTestCase):
    def test_load(self) -> None:
        """Every example is a settings file without a fault, and names a driver and options that there are."""
        self.assertEqual([file.stem for file in EXAMPLES], ["dog1", "dog2", "dog3", "laptop-bootstrap", "sensor"])
        for file in EXAMPLES:
            settings = Settings.load(str(file))
            if settings.driver.kind:
                body = describe(settings.driver.kind, settings.driver.options, settings.node.name)
                self.assertIn("camera", body.capabilities)

    def test_belong_together(self) -> None:
        """All examples are of one team, and each knows the laptop at the address where it listens."""
        every = {file.stem: Settings.load(str(file)) for file in EXAMPLES}
        laptop = every.pop("laptop-bootstrap").node
        self.assertEqual(laptop.known_nodes, ())
        for settings in every.values():
            self.assertEqual(settings.node.team_secret, laptop.team_secret)
            self.assertEqual([(a.host, a.port) for a in settings.node.known_nodes], [(laptop.host, laptop.port)])
