"""Collect the workloads that scenarios can name."""

from __future__ import annotations

from sim.team.load.auctions import Auctions, AuctionSettings
from sim.team.load.directory import Directory, DirectorySettings
from sim.team.load.lookups import Lookups, LookupSettings
from sim.team.load.records import Records, RecordSettings
from sim.team.load.takeovers import Takeovers, TakeoverSettings
from sim.team.load.tasks import Tasks, TaskSettings
from sim.team.load.traffic import Traffic, TrafficSettings
from sim.team.load.values import Values, ValueSettings
from sim.team.load.watches import Watches, WatchSettings
from sim.team.workload import Kind, Kinds

LOADS: Kinds = {
    "auctions": Kind(AuctionSettings, Auctions),
    "directory": Kind(DirectorySettings, Directory),
    "lookups": Kind(LookupSettings, Lookups),
    "records": Kind(RecordSettings, Records),
    "takeovers": Kind(TakeoverSettings, Takeovers),
    "tasks": Kind(TaskSettings, Tasks),
    "traffic": Kind(TrafficSettings, Traffic),
    "values": Kind(ValueSettings, Values),
    "watches": Kind(WatchSettings, Watches),
}
