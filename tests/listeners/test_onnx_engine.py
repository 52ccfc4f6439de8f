"""Listeners that ship, on onnxruntime: what they do is what they do on torch; what does not fit is said in one line."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import yaml
from tiny_arig import talk

from sfms_robot.config.listener import parse_listener
from sfms_robot.data import data_dir
from sfms_robot.errors import ModelError
from sfms_robot.frames import SpeakerFrame
from sfms_robot.listeners.checkpoint import WEIGHTS, load_config, save_config
from sfms_robot.listeners.engine import HALF, OnnxEngine, digest, integers, read_graphs
from sfms_robot.listeners.registry import engine_name, load_listener

LISTENERS = data_dir("configs") / "listeners"
SHIPPED = ["sfms-small", "arig-small"]
FOLDERS = sorted(file.parent for file in LISTENERS.glob("*/config.yaml"))


def people(frames: int) -> list[SpeakerFrame]:
    """Both talk in turns; one frame in five shows no face, one in seven has no sound."""
    out = talk(frames)
    for index in range(frames):
        out[index] = out[index] if index % 5 else replace(out[index], face=None)
        out[index] = out[index] if index % 7 else replace(out[index], audio=out[index].audio[:0])
    return out


def streamed(listener, speaker, seed=1):
    memory, plans, tokens = listener.start(seed), [], []
    for frame in speaker:
        plan, memory = listener.step(frame, memory)
        plans += [] if plan is None else [plan]
        tokens.append(getattr(getattr(memory, "how", memory), "tokens", 0))
    return plans, np.array(tokens)


@pytest.fixture(scope="module", params=SHIPPED)
def both(request):
    return [load_listener(request.param, engine=engine) for engine in ("onnx", "torch")]


def test_plans_are_those_of_torch(both):
    """And tokens are the same to the last: one that flips is another motion."""
    (found, drawn), (wanted, wanted_drawn) = (streamed(listener, people(60)) for listener in both)
    np.testing.assert_array_equal(drawn, wanted_drawn)
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_allclose(one.frames, other.frames, atol=1e-4)
        assert one.events == other.events


def test_auto_is_onnx_where_there_are_graphs(both):
    assert engine_name(load_listener("sfms-small")) == "onnx, 1 thread"
    assert [engine_name(listener) for listener in both] == ["onnx, 1 thread", "torch"]


@pytest.mark.parametrize("folder", [each for each in FOLDERS if (each / "onnx").is_dir()], ids=lambda each: each.name)
def test_graphs_that_ship_are_of_the_configuration_and_the_weights_that_ship(folder):
    """If this fails: sfms-robot export (with --int8 for arig-paper)."""
    found = read_graphs(folder, load_config(folder))
    if (folder / WEIGHTS).is_file():
        OnnxEngine(folder, found)


def test_no_torch_where_the_engine_is_onnx():
    code = (
        "import sys, numpy as np\n"
        "from sfms_robot.frames import SpeakerFrame\n"
        "from sfms_robot.listeners.registry import load_listener\n"
        "for name in sys.argv[1:]:\n"
        "    listener = load_listener(name, engine='onnx')\n"
        "    listener.step(SpeakerFrame(0.04, np.zeros(640, np.float32)), listener.start(0))\n"
        "sys.exit('torch was imported' if 'torch' in sys.modules else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code, *SHIPPED], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.fixture
def copied(tmp_path):
    return shutil.copytree(LISTENERS / "sfms-small", tmp_path / "mine")


def refused(folder, engine="onnx") -> str:
    with pytest.raises(ModelError) as caught:
        load_listener(folder, engine=engine)
    text = str(caught.value)
    assert caught.value.exit_code == 5 and "\n" not in text
    return text


def test_a_graph_cut_short_is_refused(copied):
    file = copied / "onnx" / "next.onnx"
    file.write_bytes(file.read_bytes()[:2000])
    assert "next.onnx: cut short, or of another model" in refused(copied)
    assert f"sfms-robot export {copied}" in refused(copied)


def test_graphs_of_another_model_are_refused(copied):
    shutil.rmtree(copied / "onnx")
    shutil.copytree(LISTENERS / "arig-small" / "onnx", copied / "onnx")
    assert "graphs.json: graphs of another configuration than" in refused(copied)


def test_a_listener_without_graphs_runs_on_torch_unless_onnx_is_asked_for(copied):
    shutil.rmtree(copied / "onnx")
    assert "no graphs of this listener for engine onnx" in refused(copied)
    assert engine_name(load_listener(copied)) == "torch"


def test_a_manifest_that_is_none_is_refused_and_with_auto_leaves_the_listener_to_torch(copied, caplog):
    whole = json.loads((copied / "onnx" / "graphs.json").read_text())
    for text in ("[]", "{", json.dumps(whole | {"format": 99}), json.dumps(whole | {"networks": {"next": {}}})):
        (copied / "onnx" / "graphs.json").write_text(text)
        assert "graphs.json: " in refused(copied)
    networks = {f"{name}.int8": network for name, network in whole["networks"].items()}
    (copied / "onnx" / "graphs.json").write_text(json.dumps(whole | {"networks": networks}))
    assert ".onnx: no such graph" in refused(copied)
    (copied / "onnx" / "graphs.json").write_text("{")
    assert engine_name(load_listener(copied)) == "torch"
    assert "torch in place of onnx" in caplog.text


def test_weights_of_another_shape_are_refused(copied):
    shutil.copy(LISTENERS / "arig-small" / "model.safetensors", copied / "model.safetensors")
    assert "model.safetensors: tensor" in refused(copied)


def test_graphs_hang_on_what_they_hold_and_on_nothing_else():
    settings = load_config(LISTENERS / "sfms-small")
    other = settings.model_copy(update={"description": "another", "hop": 2})
    assert digest(settings) == digest(other) != digest(settings.model_copy(update={"ramp_frames": 3}))


def test_integers_without_graphs_of_them_are_refused(tmp_path):
    settings = parse_listener(yaml.safe_load((LISTENERS / "arig-small" / "config.yaml").read_text()), "test")
    save_config(tmp_path, settings.model_copy(update={"precision": "int8"}))
    assert f"no graphs in 8 bits: sfms-robot export --int8 {tmp_path}" in refused(tmp_path, "torch")


def test_a_layer_in_integers_is_the_layer_within_a_percent_or_two():
    rng = np.random.default_rng(0)
    weight, x = rng.normal(size=(200, 300)).astype(np.float32), rng.normal(size=300).astype(np.float32)
    rounded, scale = integers(weight)
    assert rounded.shape == (300, 200) and rounded.dtype == np.int8 and np.abs(rounded.astype(int)).max() >= HALF
    away = (x @ rounded.astype(np.float32)) * scale - weight @ x
    assert 0 < np.linalg.norm(away) < 0.02 * np.linalg.norm(weight @ x)
