"""Apply the faults and sessions of a scenario to a simulated team."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from middleware.entangled.network.switchboard import Barrier
from sim.team.disk import SimulatedDisk
from sim.team.faults import barrier
from sim.team.faults.settings import Fault
from sim.team.team import Node, Team

FEW = 2
"""Number of nodes that never leave, so that other nodes have a network to which they can return."""


class TeamFaults:
    """The faults and sessions of a team between ``begin`` and ``end``.

    The affected nodes are drawn when a fault occurs, from the nodes in the network at that time.
    """

    def __init__(self, team: Team) -> None:
        self._team = team
        self._sessions = team.scenario.sessions
        self._rng = team.make_rng("trouble")
        self._session_rng = team.make_rng("sessions")
        self._is_on = False
        self._pending_undos: dict[int, Callable[[], None]] = {}
        self._number = 0
        self._away: dict[int, int] = {}
        """Places whose nodes will restart, each with the number of the life that has ended."""
        self._handlers: dict[str, Callable[[Fault], None]] = {
            "crash": partial(self._end_lives, kill=True),
            "leave": partial(self._end_lives, kill=False),
            "freeze": self._freeze,
            "cut": partial(self._add_barrier, barrier.isolate),
            "deaf": partial(self._add_barrier, barrier.block_incoming),
            "mute": partial(self._add_barrier, barrier.block_outgoing),
            "clog": self._clog,
            "pairs": self._pairs,
            "step": self._step,
            "rate": self._rate,
            "full": self._full,
            "crowd": self._crowd,
            "weather": self._weather,
            "rebind": self._rebind,
        }

    def begin(self) -> None:
        """Start the sessions when the team is complete, and schedule the faults."""
        team, stays = self._team, self._sessions.session_durations
        self._is_on = True
        if stays is not None:
            for place in team.alive():
                self._plan_end(place, stays.draw_remaining(self._session_rng))
            team.on_birth.append(self._on_birth)
        for number, fault in enumerate(team.scenario.faults, 1):
            team.schedule(fault.at, partial(self._start_fault, fault, number))

    def end(self) -> None:
        """End every fault, restart the nodes that are due, and stop."""
        team = self._team
        self._is_on = False
        for number in list(self._pending_undos):
            self._undo_fault(number)
        team.switchboard.barriers.clear()
        for place, life in sorted(self._away.items()):
            self._restart_away(place, life)
        team.report_event("healed")

    # -- sessions ---------------------------------------------------------------------------------------------------

    def _on_birth(self, place: int, node: Node) -> None:
        stays = self._sessions.session_durations
        if self._is_on and stays is not None:
            self._plan_end(place, stays.draw(self._session_rng))

    def _plan_end(self, place: int, seconds: float) -> None:
        self._team.schedule(seconds, partial(self._session_over, place, self._team.life_numbers[place]))

    def _session_over(self, place: int, life: int) -> None:
        team, sessions, rng = self._team, self._sessions, self._session_rng
        if not self._is_on or not self._is_present(place, life):
            return
        if len(team.living) <= FEW:
            self._plan_end(place, sessions.absence_durations.draw(rng))
            return
        if rng.random() < sessions.goodbye:
            team.leave(place)
        else:
            team.kill(place)
        self._away[place] = life
        team.schedule(sessions.absence_durations.draw(rng), partial(self._restart_away, place, life))

    def _restart_away(self, place: int, life: int) -> None:
        if self._away.get(place) != life:
            return
        del self._away[place]
        if not self._sessions.same:
            self._team.replace(place)
        self._team.start(place)

    def _is_present(self, place: int, life: int) -> bool:
        return place in self._team.living and self._team.life_numbers[place] == life

    # -- faults -----------------------------------------------------------------------------------------------------

    def _start_fault(self, fault: Fault, number: int) -> None:
        if self._is_on:
            self._team.report_event("fault", -1, f"{number}: {fault}")
            self._handlers[fault.kind](fault)

    def _draw_places(self, fault: Fault) -> list[int]:
        """Draw the nodes that a fault affects, in the order in which it spreads."""
        here = sorted(self._team.get_joined())
        if fault.places:
            return [place for place in fault.places if place in self._team.living]
        count = fault.count or round(fault.share * len(here))
        return self._rng.sample(here, min(count, len(here)))

    def _spread(self, fault: Fault, work: list[Callable[[], None]]) -> None:
        """Run all calls of ``work``, spread over ``fault.over`` seconds."""
        for turn, each in enumerate(work):
            if fault.over:
                self._team.schedule(turn * fault.over / len(work), partial(self._run_if_active, each))
            else:
                each()

    def _run_if_active(self, work: Callable[[], None]) -> None:
        if self._is_on:
            work()

    def _undo_after(self, seconds: float, undo: Callable[[], None]) -> None:
        """Call ``undo`` after ``seconds``, or in ``end`` if that is earlier."""
        self._number += 1
        self._pending_undos[self._number] = undo
        self._team.schedule(seconds, partial(self._undo_fault, self._number))

    def _undo_fault(self, number: int) -> None:
        undo = self._pending_undos.pop(number, None)
        if undo is not None:
            undo()

    def _list_hosts(self, places: list[int]) -> list[str]:
        """Return the addresses at which other nodes see these places."""
        here = [self._team.get_state(place) for place in places]
        return [place.address.host if place.nat is None else place.nat.host for place in here]

    def _end_lives(self, fault: Fault, kill: bool) -> None:
        self._spread(fault, [partial(self._end_life, place, fault.lasts, kill) for place in self._draw_places(fault)])

    def _end_life(self, place: int, lasts: float, kill: bool) -> None:
        team = self._team
        if place not in team.living:
            return
        life = team.life_numbers[place]
        if kill:
            team.kill(place)
        else:
            team.leave(place)
        if lasts:
            self._away[place] = life
            team.schedule(lasts, partial(self._restart, place, life))

    def _restart(self, place: int, life: int) -> None:
        if self._away.get(place) == life:
            del self._away[place]
            self._team.start(place)

    def _freeze(self, fault: Fault) -> None:
        self._spread(fault, [partial(self._freeze_one, place, fault.lasts) for place in self._draw_places(fault)])

    def _freeze_one(self, place: int, lasts: float) -> None:
        team = self._team
        machine = team.get_state(place).machine
        if place not in team.living or machine is None or machine.is_frozen:
            return
        life = team.life_numbers[place]
        team.freeze(place)
        self._undo_after(lasts, lambda: team.thaw(place) if self._is_present(place, life) else None)

    def _add_barrier(self, make_barrier: Callable[[list[str]], Barrier], fault: Fault) -> None:
        self._block(make_barrier(self._list_hosts(self._draw_places(fault))), fault.lasts)

    def _clog(self, fault: Fault) -> None:
        hosts = self._list_hosts(self._draw_places(fault))
        self._spread(fault, [partial(self._block, barrier.block_host(host), fault.lasts) for host in hosts])

    def _pairs(self, fault: Fault) -> None:
        self._block(barrier.block_pairs(fault.share, str(self._rng.random())), fault.lasts)

    def _block(self, rule: Barrier, lasts: float) -> None:
        barriers = self._team.switchboard.barriers
        barriers.append(rule)
        self._undo_after(lasts, lambda: barriers.remove(rule))

    def _step(self, fault: Fault) -> None:
        def step(seconds: float) -> None:
            for place in affected:
                self._team.get_state(place).wall_error += seconds

        affected = self._draw_places(fault)
        step(fault.amount)
        if fault.lasts:
            self._undo_after(fault.lasts, partial(step, -fault.amount))

    def _rate(self, fault: Fault) -> None:
        def run(factor: float) -> None:
            for place in affected:
                here = self._team.get_state(place)
                here.rate *= factor
                if here.machine is not None:
                    here.machine.set_rate(here.rate)

        affected = self._draw_places(fault)
        run(fault.amount)
        self._undo_after(fault.lasts, partial(run, 1 / fault.amount))

    def _full(self, fault: Fault) -> None:
        def fill(is_full: bool) -> None:
            for place in affected:
                store = self._team.get_state(place).store
                if isinstance(store, SimulatedDisk):
                    store.is_full = is_full

        affected = self._draw_places(fault)
        fill(True)
        self._undo_after(fault.lasts, lambda: fill(False))

    def _crowd(self, fault: Fault) -> None:
        def come() -> None:
            place = self._team.add()
            if fault.lasts:
                self._team.schedule(fault.lasts, partial(self._end_life_of, place, self._team.life_numbers[place]))

        self._spread(fault, [come] * fault.count)

    def _end_life_of(self, place: int, life: int) -> None:
        if self._is_on and self._is_present(place, life):
            self._team.leave(place)

    def _weather(self, fault: Fault) -> None:
        link = self._team.link
        link.extra_loss += fault.amount

        def clear() -> None:
            link.extra_loss -= fault.amount

        self._undo_after(fault.lasts, clear)

    def _rebind(self, fault: Fault) -> None:
        for place in self._draw_places(fault):
            home = self._team.get_state(place).nat
            if home is not None:
                home.rebind()
