"""The panel says what the status document says, in lines that fit, whatever is known and however narrow it is."""

import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from sfms_robot.app.listen.panel import view
from sfms_robot.frames import Reading, SpeakerFrame
from sfms_robot.ports import Tick
from sfms_robot.runtime.observers import RunStatus

JOINTS = ("neck_pitch", "jaw", "brow_left", "brow_right", "lid_left", "lid_right")
FIGURES = {
    "tick": {"target_hz": 100.0, "achieved_hz": 99.93, "late": 2},
    "latency_ms": {"frame_to_wire": {"p50": 11.2, "p99": 21.4}, "speech_to_wire": {"p50": None, "p95": None}},
    "motion": {"nods": 3, "blinks": 12, "smiles": 0},
}


def drawn(document, width=100, encoding="utf-8", **how):
    file = io.TextIOWrapper(io.BytesIO(), encoding)
    console = Console(file=file, width=width, force_terminal=True, color_system=None)
    console.print(view(document, console, "space halt", **how))
    file.flush()
    return file.buffer.getvalue().decode(encoding)


def status(state="listening", why=(), faults=(), loud=0.1, figures=FIGURES):
    found = RunStatus(JOINTS, {"head": "face28", "listener": "sfms-small", "duration_s": 47.7}, lambda: figures)
    readings = {
        joint: Reading(0.1, 0.0, "silent" if joint in faults else None, extra={"temperature_C": 40.0 + n})
        for n, joint in enumerate(JOINTS)
    }
    found.heard(SpeakerFrame(12.0, np.full(640, loud, np.float32), None, attention=0.62))
    found.tick(Tick(12.3, np.zeros(58, np.float32), np.zeros(len(JOINTS)), readings, state, why))
    return found.document()


def test_it_says_what_the_document_says():
    told = drawn(status("degraded", ("voice", "jaw"), faults=["jaw"]))
    for part in (
        "degraded", "voice, jaw", "continues without", "0:00:12 of 0:00:47", "face28", "-20 dB", "attention 62%",
        "no sound", "3 nods, 12 blinks, 0 smiles", "99.9 of 100 a second, 2 late", "11 ms after picture and sound",
        "lid_right 45 C", "jaw silent", "space halt",
    ):  # fmt: skip
        assert part in told
    assert "speech begins" not in told  # nobody knows yet


def test_it_shows_the_end_the_beginning_faults_hours_virtual_time_and_ascii():
    assert "stopping" in drawn(status(), ending=True) and "starting" in drawn(RunStatus(JOINTS, {}).document())
    assert "and 2 more" in drawn(status(faults=JOINTS))
    assert "2:00:05 of 3:00:00" in drawn({**status(), "time_s": 7205.4, "duration_s": 10800.0})
    late = {"tick": {"target_hz": 100.0, "achieved_hz": None, "late": None}}
    assert "virtual time" in drawn(status(figures=late))
    assert "####" in drawn(status(), encoding="ascii")


@pytest.mark.parametrize("width", [40, 80, 200])
@given(
    level=st.one_of(st.none(), st.floats(-200, 20)), why=st.lists(st.text("abc_", min_size=1, max_size=30), max_size=6),
    time_s=st.floats(0, 1e6),
)  # fmt: skip
def test_no_line_is_wider_than_the_terminal(width, level, why, time_s):
    document = status("degraded", tuple(why), faults=JOINTS)
    document["person"] |= {"voice_db": level, "own_voice_db": level}
    assert max(map(len, drawn(document | {"time_s": time_s}, width).splitlines())) <= width
