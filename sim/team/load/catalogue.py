"""Collect the workloads that a scenario can select."""

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
from sim.team.workload import WorkloadKind, WorkloadKinds

LOADS: WorkloadKinds = {
    "auctions": WorkloadKind(AuctionSettings, Auctions),
    "directory": WorkloadKind(DirectorySettings, Directory),
    "lookups": WorkloadKind(LookupSettings, Lookups),
    "records": WorkloadKind(RecordSettings, Records),
    "takeovers": WorkloadKind(TakeoverSettings, Takeovers),
    "tasks": WorkloadKind(TaskSettings, Tasks),
    "traffic": WorkloadKind(TrafficSettings, Traffic),
    "values": WorkloadKind(ValueSettings, Values),
    "watches": WorkloadKind(WatchSettings, Watches),
}
