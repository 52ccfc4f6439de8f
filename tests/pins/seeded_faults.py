"""Sixty seeded faults, and which of them the tests catch.

    python tests/pins/seeded_faults.py            run all, write tests/pins/golden/faults.json (half an hour)
    python tests/pins/seeded_faults.py 3 17       run these, print the outcome

Each fault is one edit of the package. It is caught when a test of the folders beside it fails. A rearranged project has
to catch the same faults: where a line moves, its entry here moves with it, and the list of what is caught may not
shrink. Edits are made in a copy of the checkout.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
GOLDEN = Path(__file__).parent / "golden" / "faults.json"
LIMIT_S = 900  # a fault that makes a test hang is caught


class Fault(NamedTuple):
    """One edit: `old` stands once in `file`, and becomes `new`; `tests` are run with it."""

    file: str
    old: str
    new: str
    tests: str


MOTION, WIRE, SOURCES, LOOP = "tests/motion", "tests/servo", "tests/sources", "tests/runtime tests/drills"
LIMITS, TIMELINE, STARTUP = "motion/limits.py", "motion/timeline.py", "servo/chain/startup.py"
DXL2, PROTOCOL1, MAESTRO, SSC32 = (f"servo/codecs/{name}.py" for name in ("dxl2", "protocol1", "maestro", "ssc32"))
FAULTS = (
    # limiter
    Fault(LIMITS, "limits.speed * _HEADROOM", "limits.speed * 1.01", MOTION),
    Fault(LIMITS, "limits.acceleration * _HEADROOM", "limits.acceleration * 1.05", MOTION),
    Fault(LIMITS, "limits.jerk * _HEADROOM", "limits.jerk * 1.1", MOTION),
    Fault(
        LIMITS, "[self._jerk] * 3 + [self._acceleration] * 2", "[self._jerk] * 3 + [self._acceleration * 2] * 2", MOTION
    ),
    Fault(LIMITS, "half = (high - low) / 2 + _EDGE_SLACK_RAD", "half = (high - low) / 2 + 0.01", MOTION),
    Fault(LIMITS, "if not all(map(math.isfinite, reference)):", "if not math.isfinite(reference[0]):", MOTION),
    Fault(
        LIMITS,
        "        np.minimum(after[0], high, out=after[0])\n        return after, chased",
        "        return after, chased",
        MOTION,
    ),
    Fault(LIMITS, "inner[0, 2] += 1.0", "inner[0, 2] += 0.9", MOTION),
    Fault(LIMITS, "[jerks[0] * (dt / 3), -jerks[2] * (dt / 3)]", "[jerks[0] * (dt / 3), jerks[2] * (dt / 3)]", MOTION),
    Fault(LIMITS, "way = 1.0 if low < first else -1.0", "way = -1.0 if low < first else 1.0", MOTION),
    Fault("ranges.py", "np.minimum(self.low, last_rad)", "np.minimum(self.low, last_rad - 0.01)", MOTION),
    Fault(
        "motion/calibration.py",
        "np.rint(ticks), self.low_ticks)",
        "np.floor(ticks), self.low_ticks - 1)",
        f"{MOTION} {WIRE}",
    ),
    # timeline
    Fault(TIMELINE, "plan.made_at_s < old.made_at_s", "plan.made_at_s < old.made_at_s - 1", MOTION),
    Fault(TIMELINE, "step_s / 4\n        late", "step_s\n        late", MOTION),
    Fault(TIMELINE, "np.maximum(before[BLINKS], after[BLINKS])", "blend[BLINKS]", MOTION),
    Fault(TIMELINE, "delay_s = FRAME_S if len(times_s) == 1 else 0.0", "delay_s = 0.0", MOTION),
    Fault(TIMELINE, "b0 / 2,", "b0,", MOTION),
    Fault(TIMELINE, "numbers = (times_s, frames, ", "numbers = (times_s, ", MOTION),
    Fault(TIMELINE, "    clip_shapes(frames)\n", "", MOTION),
    Fault(TIMELINE, "(1 - ease((asked_s - curve.made_at_s - STALL_S) / EASE_S))[:, None]", "1.0", MOTION),
    Fault(TIMELINE, "slopes[:kept], bends[:kept] = past.slopes[:kept], past.bends[:kept]", "pass", MOTION),
    # codecs
    Fault(DXL2, "(len(body) + 2).to_bytes", "(len(body) + 3).to_bytes", WIRE),
    Fault(DXL2, '_LOOKALIKE: Final = b"\\xff\\xff\\xfd"', '_LOOKALIKE: Final = b"\\xff\\xfd\\xfd"', WIRE),
    Fault(DXL2, "if 7 <= again <= total - 6:", "if False:", WIRE),
    Fault(DXL2, "if not whole and not _proved(data[:end]):", "if not whole and False:", WIRE),
    Fault(DXL2, "return Packet(servo, STATUS, body[2:], body[1])", "return Packet(servo, STATUS, body[2:], 0)", WIRE),
    Fault(PROTOCOL1, "bytes([~sum(body) & 0xFF])", "bytes([sum(body) & 0xFF])", WIRE),
    Fault(PROTOCOL1, "if ~sum(buffer[2 : total - 1]) & 0xFF != buffer[total - 1]:", "if False:", WIRE),
    Fault(PROTOCOL1, "if servo == 0xFF or length < 2:", "if length < 2:", WIRE),
    Fault(PROTOCOL1, "bytes([length, servo, address])", "bytes([servo, length, address])", WIRE),
    Fault(PROTOCOL1, "bytes([address, length, *servos])", "bytes([length, address, *servos])", WIRE),
    Fault(MAESTRO, "bytes([value & 0x7F, value >> 7])", "bytes([value >> 7, value & 0x7F])", WIRE),
    Fault(MAESTRO, "if not 0 <= value <= MAX_WORD:", "if not 0 <= value:", WIRE),
    Fault(SSC32, "if not MIN_PULSE_US <= move.pulse_us <= MAX_PULSE_US:", "if False:", WIRE),
    Fault(SSC32, 'f"#{channel}L"', 'f"#{channel}H"', WIRE),
    # startup
    Fault(
        STARTUP, 'self._write(self._field("goal_position"), goal)', 'self._write(self._field("goal_position"), 0)', WIRE
    ),
    Fault(
        STARTUP, "if table.model_number is not None and found.model_number != table.model_number:", "if False:", WIRE
    ),
    Fault(STARTUP, "if limits is not None and not _inside(present, limits):", "if False:", WIRE),
    Fault("servo/chain/protocol2.py", "len(params) == length or (error & 0x7F and not params)", "True", WIRE),
    Fault(STARTUP, "return limits[0] <= ticks <= limits[1]", "return limits[0] <= ticks", WIRE),
    # halt
    Fault("runtime/halt.py", 'if door in ("device", cause[1]) and', "if", LOOP),
    Fault("runtime/halt.py", "        if active:\n", "        if False:\n", LOOP),
    Fault("runtime/halt.py", "self._closed.get(cause) == closing:", "cause in self._closed:", LOOP),
    Fault("runtime/halt.py", '            bus.torque_off("release")', "            pass", LOOP),
    Fault("runtime/halt.py", "return not path.parent.is_dir()", "return False", LOOP),
    Fault("runtime/loop.py", "if state.run.since_s == now_s and released.any():", "if False:", LOOP),
    Fault("runtime/loop.py", "if not parts.halt.causes:", "if True:", LOOP),
    Fault("runtime/states.py", "        elif halted:", "        elif False:", LOOP),
    # decoders
    Fault("sources/live_link.py", "if 0 < data[0] < VERSION:", "if data[0] > VERSION:", SOURCES),
    Fault("sources/live_link.py", "return motion_of(packet.values)", "return packet.values[:58]", SOURCES),
    Fault("sources/live_link.py", "if forward < 0:", "if forward < -9:", SOURCES),
    Fault("sources/live_link.py", "values <= len(data) == values + 4 * data[values - 1]", "True", SOURCES),
    Fault(
        "sources/live_link.py",
        '_FRAME: Final = struct.Struct(">ifiiB")',
        '_FRAME: Final = struct.Struct("<ifiiB")',
        SOURCES,
    ),
    Fault("sources/vmc.py", "[-y, 0.0, z]", "[y, 0.0, z]", SOURCES),
    Fault("sources/vmc.py", "if _is_number(value) and math.isfinite(value):", "if _is_number(value):", SOURCES),
    Fault("sources/vmc.py", "if size <= 0 or start + size > len(data):", "if start + size > len(data):", SOURCES),
    Fault("sources/vmc.py", "+ 2.0 * w * cross", "- 2.0 * w * cross", SOURCES),
    Fault("signals/tracks.py", '"cm": 0.01', '"cm": 0.1', "tests/signals"),
    Fault("signals/tracks.py", "motion[np.isnan(motion).any(axis=1)] = np.nan", "pass", "tests/signals"),
    Fault(
        "signals/tracks.py",
        "out[outside | (gap_s > _LONGEST_GAP_S)] = np.nan",
        "out[outside] = np.nan",
        "tests/signals",
    ),
)


def outcome(number: int) -> str:
    """Apply one fault to a copy of the checkout and run its tests; "caught" or "missed". Blocks for minutes."""
    fault = FAULTS[number]
    with tempfile.TemporaryDirectory() as tmp:
        copy = Path(tmp) / "checkout"
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".*", "node_modules", "__pycache__", "runs"))
        file = copy / "sfms_robot" / fault.file
        text = file.read_text(encoding="utf-8")
        if text.count(fault.old) != 1:
            raise SystemExit(f"fault {number}: {fault.file}: {fault.old!r} stands {text.count(fault.old)} times")
        file.write_text(text.replace(fault.old, fault.new), encoding="utf-8")
        words = ["-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-m", "not slow and not hardware and not gpu"]
        environment = {**os.environ, "PYTHONPATH": str(copy), "OMP_NUM_THREADS": "1"}
        try:
            done = subprocess.run(
                [sys.executable, *words, *fault.tests.split()],
                cwd=copy, env=environment, capture_output=True, text=True, timeout=LIMIT_S, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return "caught"
        if done.returncode not in (0, 1, 2):
            raise SystemExit(
                f"fault {number}: pytest ended with {done.returncode}: {done.stdout[-500:]}{done.stderr[-500:]}"
            )
        return "caught" if done.returncode else "missed"


def main() -> None:
    """Run the faults named on the command line, or all of them and write the list."""
    numbers = [int(word) for word in sys.argv[1:]] or range(len(FAULTS))
    found = {}
    for number in numbers:
        found[number] = outcome(number)
        sys.stdout.write(f"{number} {FAULTS[number].file} {FAULTS[number].old[:50]!r}: {found[number]}\n")
        sys.stdout.flush()
    if len(found) == len(FAULTS):
        missed = [number for number, each in found.items() if each == "missed"]
        GOLDEN.write_text(json.dumps({"faults": len(FAULTS), "missed": missed}) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
