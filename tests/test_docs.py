"""The documents: what they point to exists, and the examples are lawful settings."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from agents import body, engagement, loop
from agents.catalogue import TASKS
from drivers.phone import driver, option
from drivers.registry import describe
from middleware import fault, halt, takeover
from middleware.commitment import ballot, lessee
from middleware.consensus import guard, strategy, worker
from middleware.deployment import manifest, module
from middleware.dissemination import check, party, scale, teller, tree
from middleware.entangled.control import port
from middleware.entangled.kademlia import membership, roster
from middleware.entangled.replication import handover, pusher, replica, subscriber
from middleware.entangled.space import shelf, template
from middleware.settings import Settings
from swarmnode import gateway
from webnode import channel, jpeg, limits, live, team
from webnode.board import AUDITED
from webnode.routes import orders, phones

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), ROOT / "benchmarks" / "README.md"]
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
NAMED = re.compile(r"`([\w./-]+\.(?:py|toml|json|md))(?:::(\w+))?`")
EXAMPLES = sorted((ROOT / "examples").glob("*.toml"))
FIGURES: Sequence[tuple[str, str]] = (
    ("agents", f"one turn each {1000 * loop.TICK:g} ms"),
    ("agents", f"the first at once, the second {lessee.STAGGER:g} s later"),
    ("consensus", f"Each rank waits {lessee.STAGGER:g} s longer than the one before it"),
    ("consensus", f"News of a release is believed for {lessee.FRESH:g} s"),
    ("consensus", f"*sending* + ttl x {1.0 - lessee.CLOCK_MARGIN:g}"),
    ("consensus", f"the lowest {ballot.LIFE.bit_length() - 1} bits of the counter"),
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
    ("deployment", f"the source has at most {manifest.MAX_SOURCE // 1024} KiB"),
    ("deployment", f"takes at most {module.STEPS:,} instructions"),
    ("faults", f"Seconds are {fault.MIN_S:g} to {fault.MAX_S:g}, {fault.USUAL_S:g} where"),
    ("faults", f"later than {takeover.TARGET_S:g} s, or nobody took over"),
    ("faults", f"below {body.EMPTY:g} its agent takes its report back"),
    ("library", f"After about {membership.SILENCE + roster.STRUCK_S:g} s the absent are struck"),
    ("library", f"A request has at most {port.MAX_REQUEST:,} bytes, a node {port.MAX_CONNECTIONS} connections"),
    ("phone", f"says nothing for {gateway.SILENCE_S:g} s has gone as well"),
    ("phone", f"from {driver.STALE_S:g} s on it counts as silent"),
    ("phone", f"| {gateway.MOST}: each is a node"),
    ("phone", f"| {option.FPS:g} a second wanted while it has a task, {gateway.IDLE_FPS:g} else"),
    ("phone", f"more than {gateway.LOOKS_S:g} a second ({gateway.LOOKS:g} at once)"),
    ("phone", f"at most {jpeg.MOST_SIDE} pixels a side"),
    ("phone", f"no others, {phones.TICKET_S / 3600:g} hours"),
    ("phone", f"{option.LENS_DEG:g} degrees across the longer side"),
    ("phone", f"keeps it in view for {TASKS['watch-target'].parameters['seconds']:g} s in all"),
    ("phone", f"in view for {TASKS['watch-target'].stall_limit:g} s gives the task to another"),
    ("protocol", f"gone on without it for {roster.STRUCK_S:g} s, or for {roster.COUNTED_S:g} s"),
    ("protocol", f"out of touch with a majority for {handover.OUT_OF_TOUCH:g} s"),
    ("protocol", f"Pages hold about {replica.PAGE_BYTES:,} bytes"),
    ("protocol", f"counts for {pusher.WATCH_TTL:g} s and is asked again every {subscriber.RENEW:g} s"),
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
    ("tuplespace", f"1 to {template.MAX_FIELDS} fields"),
    ("tuplespace", f"asked every {shelf.POLL:g} s whether"),
    ("actions", f"after {team.PATIENCE:g} s at the latest"),
    ("actions", f"place the target, {team.PLACING:g} s later"),
    ("protocol", f"is on: bool, by: at most {halt.MAX_NAME} characters"),
    ("web", f"`text`, 1 to {orders.MAX_MESSAGE} characters"),
    ("web", f"`seconds`, {orders.MIN_AWAY_S:g} to {orders.MAX_AWAY_S:g}, default {orders.AWAY_S:g}"),
    ("web", f"At most {live.MAX_VIEWERS} streams"),
)
"""What a document says with a figure of the code in it."""


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
