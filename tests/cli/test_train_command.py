"""`train` on a few seconds of made-up conversation: figures, one line for any error, Ctrl-C and how to continue."""

import signal
import subprocess
import sys

import pytest
import yaml
from ended import PROGRAM
from tiny_sfms_training import configuration, write_dyads

from sfms_robot import config
from sfms_robot.data import data_dir
from sfms_robot.errors import install_command


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_dyads(tmp_path_factory.mktemp("data"))


@pytest.fixture
def arguments(tmp_path, data):
    """Write a configuration to a file; return the options of a tiny training with it."""

    def write(raw=None) -> list[str]:
        file = tmp_path / "tiny.yaml"
        file.write_text(yaml.safe_dump(raw or configuration(), sort_keys=False))
        return ["--config", str(file), "--data", str(data), "--out", str(tmp_path / "out"), "--device", "cpu"]

    return write


@pytest.fixture
def fails(command_line, arguments):
    """Run a phase that must fail; return the one line on stderr."""

    def run(phase: str, *more: str, raw=None, code: int = 2) -> str:
        ended = command_line("train", phase, *arguments(raw), *more)
        (line,) = [line for line in ended.err.splitlines() if line.startswith("sfms-robot:")]
        assert ended.code == code, line
        return line

    return run


@pytest.fixture
def done(command_line, arguments):
    """Run a phase that ends well; return its figures and stderr."""

    def run(phase: str, *more: str, raw=None):
        ended = command_line("train", phase, *arguments(raw), "--no-tensorboard", *more, "--json")
        assert ended.code == 0, ended.err
        return ended.told, ended.err

    return run


def test_both_phases_print_figures_and_write_a_folder_that_runs(done, tmp_path):
    before = signal.getsignal(signal.SIGINT)
    first, bar = done("tokenizer")
    assert first["steps"] == 6 and first["mse"] > 0 and first["stopped"] == "steps" and "loss" in bar
    second, _ = done("listener", "--steps", "4")
    assert second["steps"] == 4 and second["held_out_loss"] > 0
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"config.yaml", "tokenizer.safetensors", "model.safetensors"} <= names
    assert {"checkpoint-tokenizer.safetensors", "checkpoint-listener.safetensors"} <= names
    assert "tensorboard" not in names and signal.getsignal(signal.SIGINT) is before


def test_both_phases_train_in_16_bits(done, monkeypatch):
    monkeypatch.setattr("torch.cpu._is_avx512_bf16_supported", lambda: True)
    raw = configuration()
    for phase, command in (("tokenizer", "tokenizer"), ("predictor", "listener")):
        raw[phase] |= {"precision": "bf16", "steps": 2}
        assert done(command, raw=raw)[0]["steps"] == 2


def test_curves_go_to_tensorboard(done, tmp_path):
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    done("tokenizer", "--tensorboard")
    curves = events.EventAccumulator(str(tmp_path / "out" / "tensorboard" / "tokenizer"))
    curves.Reload()
    assert {"loss", "held_out_loss", "learning_rate", "frames_per_s"} <= set(curves.Tags()["scalars"])
    assert [point.step for point in curves.Scalars("held_out_loss")] == [3, 6]


def test_curves_that_were_asked_for_name_the_missing_extra(arguments):
    program = [sys.executable, "-c", f"import sys; sys.modules['tensorboard'] = None; {PROGRAM[-1]}"]
    command = [*program, "train", "tokenizer", *arguments(), "--tensorboard"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    needs = f"--tensorboard needs tensorboard, which is not installed: {install_command('train')}"
    assert (ended.returncode, ended.stderr) == (2, f"sfms-robot: {needs}\n")


def test_a_finished_training_is_kept_resumed_or_overwritten_as_asked(done, fails, tmp_path):
    before, _ = done("tokenizer")
    after, log = done("tokenizer", "--resume")
    assert "had already finished at step 6" in log and after["mse"] == before["mse"] and after["resumed_at"] == 6
    wider = configuration()
    wider["listener"]["tokenizer_width"] = 16
    assert "listener.tokenizer_width = 8 there, 16 now" in fails("tokenizer", "--resume", raw=wider)
    weights = tmp_path / "out" / "tokenizer.safetensors"
    kept, line = weights.read_bytes(), fails("tokenizer", "--steps", "3")
    assert f"{weights} is of an earlier training: --resume continues it, --overwrite" in line
    assert weights.read_bytes() == kept
    weights.unlink()
    assert "checkpoint-tokenizer.safetensors is of an earlier training" in fails("tokenizer", "--steps", "3")
    again, _ = done("tokenizer", "--steps", "3", "--overwrite")
    assert again["steps"] == 3 and weights.exists()


@pytest.mark.parametrize("name", ["model.safetensors", "config.yaml"])
def test_a_tokenizer_is_not_trained_into_the_folder_of_a_listener(fails, tmp_path, name):
    """It would replace the listener's configuration, and lose what was calibrated."""
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).write_bytes(b"whole")
    assert f"{name} is of an earlier training" in fails("tokenizer")
    assert [file.read_bytes() for file in (tmp_path / "out").iterdir()] == [b"whole"]


def test_what_cannot_begin_is_one_line(fails):
    assert "checkpoint-tokenizer.safetensors: no checkpoint to resume from" in fails("tokenizer", "--resume")
    assert "tokenizer.safetensors: no such weights file" in fails("listener", code=5)
    line = fails("tokenizer", "--order", "pose-first")
    assert "--order pose-first: composed files name their channels" in line


def test_a_gpu_that_is_not_there(fails):
    import torch

    if torch.cuda.is_available():
        pytest.skip("there is one")
    line = fails("tokenizer", "--device", "cuda")
    assert "--device cuda: torch sees no CUDA device here (auto, cpu)" in line


def test_ctrl_c_saves_says_how_to_continue_and_exits_130(arguments, tmp_path):
    raw = configuration()
    raw["tokenizer"] |= {"steps": 1_000_000, "checkpoint_every": 5}
    command = [*PROGRAM, "train", "tokenizer", *arguments(raw), "--no-tensorboard"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as running:
        while not (tmp_path / "out" / "checkpoint-tokenizer.safetensors").exists():
            with pytest.raises(subprocess.TimeoutExpired):  # it still runs
                running.wait(timeout=0.1)
        running.send_signal(signal.SIGINT)
        told = running.communicate()[1]
    assert running.returncode == 130
    assert "tokenizer: interrupted after step" in told and "of 1000000" in told and "--resume continues" in told
    assert "Traceback" not in told
    assert not (tmp_path / "out" / "tokenizer.safetensors").exists()


WRONG = [
    ("tokenizer.steps", 0, "tokenizer.steps = 0"),
    ("tokenizer.learning_rate", float("nan"), "tokenizer.learning_rate = nan"),
    ("listener.kind", "other", "listener.kind = 'other'"),
    ("tokenizer.temperature", [2.0], "tokenizer.temperature"),
    ("tokenizer.temperature", [2.0, 0.0], "tokenizer.temperature.1 = 0.0"),
    ("tokenizer.stpes", 5, "'stpes' is not a known key (steps, batch,"),
    ("predictor.group_weights", {"chin": 2}, ".group_weights: 'chin' is not a group of the listener (neck, face)"),
    ("predictor.group_weights", {"neck": 0}, "predictor.group_weights.neck = 0"),
    ("predictor", None, "predictor"),
    ("tokenizer", configuration()["tokenizer"] | {"evaluate_every": 0, "patience": 3}, "patience 3 needs evaluate_"),
]


@pytest.mark.parametrize(("key", "value", "part"), WRONG, ids=[f"{key}={str(value)[:20]}" for key, value, _ in WRONG])
def test_a_wrong_training_key_is_one_line(fails, key, value, part):
    raw = configuration()
    *path, last = key.split(".")
    (raw[path[0]] if path else raw)[last] = value
    line = fails("tokenizer", raw=raw)
    assert part in line and "tiny.yaml" in line


def test_the_shipped_configuration_is_valid():
    for file in (data_dir("configs") / "training").glob("sfms-*.yaml"):
        assert config.load(config.Training, file).tokenizer.steps > 0
