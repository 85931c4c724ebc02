"""What ``swarmnode.warmth`` promises."""

from __future__ import annotations

import gc

from twisted.trial.unittest import SynchronousTestCase

from swarmnode.warmth import warmed_up


class WarmthTests(SynchronousTestCase):
    def test_look_at_what_is_new_only(self) -> None:
        """What was there before is looked through no more for garbage; what came after is."""
        self.addCleanup(gc.unfreeze)
        before: list[object] = [[]]
        warmed_up()
        after: list[object] = [[]]
        looked_at = {id(each) for each in gc.get_objects()}
        self.assertNotIn(id(before), looked_at)
        self.assertIn(id(after), looked_at)
