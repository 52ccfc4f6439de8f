"""`sfms-robot bench`: each part against a peer or a baseline, both measured in the same run.

| name | measured | peer |
|---|---|---|
| help | process start of `sfms-robot --help` | the same Python doing nothing |
| bus.write, bus.tick | our sync write; write and read of a head (CPU time) | the vendor SDK's own group calls |
| retarget.tick | timeline, mapping, limits of a head | a plain matrix product of the mapping's size |
| listener.plan | one plan on one thread | the time it covers: hop x 40 ms |
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from sfms_robot.app.bench.bus import bus
from sfms_robot.app.bench.listener import listener
from sfms_robot.app.bench.measure import Row
from sfms_robot.app.bench.retarget import retarget
from sfms_robot.app.bench.startup import startup

PARTS: Mapping[str, Callable[[], dict[str, Row]]] = {
    "startup": startup,
    "bus": bus,
    "retarget": retarget,
    "listener": listener,
}


def run_bench(name: str) -> dict[str, Row]:
    """Measure `name`, or everything for "all". A row has median, p99, unit, peer, peer_median and ratio."""
    chosen = PARTS.values() if name == "all" else [PARTS[name]]
    return {key: row for part in chosen for key, row in part().items()}
