"""`sfms-robot bench`: each part against a peer or a baseline, both measured in the same run.

| name | measured | peer |
|---|---|---|
| help | process start of `sfms-robot --help` | the same Python doing nothing |
| bus.write, bus.tick | our sync write; write and read of a head (CPU time) | the vendor SDK's own group calls |
| bus.cpu_share, bus.wire_use, bus.one_silent | of a core; of the line; ticks with one servo dead | the same |
| retarget.tick | mapping, limits, calibration of a head (CPU time) | a plain matrix product of the mapping's size |
| retarget.stewart | inverse of a six-legged platform | a 6 x 3 matrix product |
| lead | how late the joints are | the same joints with no lead |
| listener.plan | one plan on one thread | the time it covers: hop x 40 ms |
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from sfms_robot.app.bench.adversary import adversarial
from sfms_robot.app.bench.bus import bus
from sfms_robot.app.bench.lead import lead
from sfms_robot.app.bench.listener import listener
from sfms_robot.app.bench.measure import HEAD, Row
from sfms_robot.app.bench.retarget import retarget
from sfms_robot.app.bench.startup import startup
from sfms_robot.errors import ConfigError

PARTS: Mapping[str, Callable[[], dict[str, Row]]] = {
    "startup": startup,
    "bus": bus,
    "retarget": retarget,
    "lead": lead,
    "listener": listener,
}


def run_bench(name: str, head: str | None = None, frames: int | None = None) -> dict[str, Row]:
    """Measure `name`, or everything for "all". A row has median, p99, unit, peer, peer_median and ratio.

    `head`: another one for "lead", and for "retarget" with wild `frames`. Raises ConfigError where they mean nothing.
    """
    if frames is not None and name != "retarget":
        raise ConfigError(f"--frames {frames}: only 'bench retarget' takes wild frames")
    if head is not None and name != "lead" and frames is None:
        raise ConfigError(f"--head {head}: only 'bench lead' and 'bench retarget --frames N' take a head")
    if frames is not None:
        return adversarial(frames, (head,) if head else ())
    if name == "lead":
        return lead(head or HEAD)
    chosen = PARTS.values() if name == "all" else [PARTS[name]]
    return {key: row for part in chosen for key, row in part().items()}
