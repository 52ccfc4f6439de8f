"""`sfms-robot bench`: each part against a peer or a baseline, both measured in the same run.

| name | measured | peer |
|---|---|---|
| startup.help, .wrong_port, .wrong_head | until the process is over | the same Python doing nothing |
| startup.first_goal, .exit, .resident | `run` typed to first goal; last byte to the end; memory | the same |
| own-voice | own voice taken for the person, person missed, in rooms, over own voice and motors | what is so in truth |
| memory.growth | resident memory that a run gains per virtual hour, after the first | resident memory after it |
| bus.write, bus.tick | our sync write; write and read of a head, of each family (CPU time) | the vendor's own calls |
| bus.cpu_share, bus.wire_use, bus.one_silent | of a core; of the line; ticks with one servo dead | the same |
| retarget.tick | mapping, limits, calibration of a head (CPU time) | a plain matrix product of the mapping's size |
| retarget.stewart | inverse of a six-legged platform | a 6 x 3 matrix product |
| lead | how late the joints are | the same joints with no lead |
| listener.plan | one plan on one thread | the time it covers: hop x 40 ms |

`bench webcam` (`webcam_bench.py`), `live` (`live_bench.py`, `torture_bench.py`), `campaign` and `fuzz` have tables of
their own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from sfms_robot.app.bench.adversary import adversarial
from sfms_robot.app.bench.bus_bench import bus
from sfms_robot.app.bench.lead import lead
from sfms_robot.app.bench.listener_bench import listener
from sfms_robot.app.bench.measure import HEAD, Row, beside
from sfms_robot.app.bench.memory_bench import HOURS, memory
from sfms_robot.app.bench.retarget_bench import retarget
from sfms_robot.app.bench.startup_bench import startup
from sfms_robot.errors import ConfigError

PARTS: Mapping[str, Callable[[], dict[str, Row]]] = {
    "startup": startup,
    "bus": bus,
    "retarget": retarget,
    "lead": lead,
    "listener": listener,
}


def run_bench(
    name: str,
    head: str | None = None,
    frames: int | None = None,
    against: Path | None = None,
    hours: float = HOURS,
) -> dict[str, Row]:
    """Measure `name`, or everything for "all". A row has median, p99, unit, peer, peer_median and ratio.

    `head`: another one for "lead", and for "retarget" with wild `frames`. `against`: a folder with another
    installation, which becomes the peer; the two run in turn. `hours`: of "memory". Raises ConfigError where they mean
    nothing.
    """
    if name == "memory":
        return memory(hours)
    if against is not None:
        return startup(against) if name == "startup" else beside(name, against)
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
