"""The parts of `sfms-robot bench listener` that judge rather than time."""

import pytest
from tiny_arig import arig_listener

from sfms_robot.lab.bench.listener_bench import in_run
from sfms_robot.listeners import checkpoint


@pytest.mark.slow
@pytest.mark.realtime
def test_a_listener_is_measured_beside_the_servo_loop(tmp_path):
    listener = arig_listener()
    checkpoint.save_config(tmp_path, listener.settings)
    checkpoint.save_weights(tmp_path / checkpoint.WEIGHTS, listener.model)
    found = in_run(tmp_path, duration_s=2.0)
    assert found["frames"] == 50 and found["duration_s"] >= 2.0
    assert found["frames_per_s"] > 0 and found["frame_to_wire_ms"]["p99"] > 0
    assert 0 <= found["late_ticks"] <= found["ticks"]
