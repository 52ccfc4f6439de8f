"""How engines are laid side by side."""

import math
import shutil

from sfms_robot.config import load_listener as load_settings
from sfms_robot.data import data_dir
from sfms_robot.lab.bench import listener_bench
from sfms_robot.lab.bench.measure import listener_process
from sfms_robot.listeners.registry import load_listener

LISTENERS = data_dir("configs") / "listeners"


def test_a_listener_with_graphs_runs_on_both_engines(tmp_path):
    folder = LISTENERS / "sfms-small"
    assert listener_bench.engines_of(folder, tmp_path) == {
        "eager": (folder, "torch"), "onnx": (folder, "onnx"),
    }  # fmt: skip
    bare = shutil.copytree(folder, tmp_path / "bare", ignore=shutil.ignore_patterns("onnx"))
    assert [*listener_bench.engines_of(bare, tmp_path)] == ["eager"]


def test_another_precision_is_another_folder_with_the_same_weights(tmp_path):
    folder = LISTENERS / "arig-paper"
    exact, _ = listener_bench.engines_of(folder, tmp_path)["eager"]
    assert exact != folder and load_settings(exact / "config.yaml").precision == "fp32"


def test_hearing_and_planning_are_told_apart_and_a_frame_is_their_mean():
    streams = {engine: listener_bench.Stream(found, found.start(0)) for engine, found in _both().items()}
    listener_bench.take_turns(streams, listener_bench.talk(), turns=2)
    for stream in streams.values():
        hop = stream.listener.hop
        assert len(stream.frame_ms) == len(stream.planning_ms) == 2 * listener_bench.TURN_HOPS
        assert len(stream.hearing_ms) == (hop - 1) * len(stream.planning_ms)
        assert math.isclose(sum(stream.frame_ms) * hop, sum(stream.planning_ms) + sum(stream.hearing_ms))
    figures = streams["onnx"].figures(streams["torch"])
    assert figures["engine"] == "onnx, 1 thread" and figures["peer_median"] > 0
    (line,) = listener_bench.engine_table({"sfms-small onnx": figures, "sfms-small": figures})
    assert line["measured"] == "sfms-small onnx" and line["planning ms"] == figures["planning_ms"]["p50"]


def test_a_listener_process_says_when_it_plans_and_what_memory_it_takes():
    told = listener_process(LISTENERS / "sfms-small", "onnx", repeats=1)
    assert told["first_plan_s"] > 0 and 0 < told["resident_mb"] <= told["peak_mb"]


def _both():
    return {engine: load_listener("sfms-small", engine=engine) for engine in ("onnx", "torch")}
