"""What ``webnode.desk`` promises."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from webnode.desk import Desk, MemoryDesk
from webnode.errors import Refusal


class MemoryDeskTests(SynchronousTestCase):
    def test_write_down(self) -> None:
        """Each wish is written down in order, and tasks get ids of their own."""
        memory = MemoryDesk([{"name": "search", "title": "Search"}])
        desk: Desk = memory
        self.assertNotEqual(desk.run_demo(), desk.assign("search")["id"])
        desk.cancel("t")
        desk.message("", "hello")
        desk.disconnect("ab", 3.0)
        wishes = [("demo",), ("assign", "search"), ("cancel", "t"), ("message", "", "hello"), ("disconnect", "ab", 3.0)]
        self.assertEqual(memory.asked, wishes)

    def test_refuse_unknown_task(self) -> None:
        """A task that is not in the catalogue is refused with what to do."""
        error = self.assertRaises(Refusal, MemoryDesk().assign, "fly")
        self.assertEqual((error.field, error.status), ("name", 404))

    def test_move_target(self) -> None:
        """The target moves in the yard of the desk, and goes; without a yard it is only written down."""
        desk = MemoryDesk(yard={"walls": [3.0, 2.4], "dogs": [], "target": None})
        desk.move_target(1.0, 2.0)
        self.assertEqual((desk.yard() or {})["target"], {"x": 1.0, "y": 2.0, "radius": 0.08})
        desk.clear_target()
        self.assertIsNone((desk.yard() or {})["target"])
        bare = MemoryDesk()
        bare.move_target(1.0, 2.0)
        bare.clear_target()
        self.assertIsNone(bare.yard())
