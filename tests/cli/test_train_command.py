"""`train` on a few seconds of made-up conversation: figures out, one line for whatever is wrong, Ctrl-C and back."""

import signal
import subprocess
import sys

import numpy as np
import pytest
import yaml

from sfms_robot.data import data_dir
from sfms_robot.frames import BLENDSHAPES, FRAME_SAMPLES, POSE_CHANNELS
from sfms_robot.lab.corpora import clips

FRAMES = 110
START = "from sfms_robot.cli.main import main; main()"


def dyad(name: str, seed: int) -> clips.Dyad:
    rng = np.random.default_rng(seed)
    motion = (0.2 + 0.1 * np.sin(np.arange(FRAMES)[:, None] / 6 + rng.uniform(0, 6, 58))).astype(np.float32)
    audio = rng.normal(0, 0.05, FRAMES * FRAME_SAMPLES).astype(np.float32)
    return clips.Dyad(
        name=name, audio=audio, speaker=motion[::-1].copy(), listener=motion, listening=np.ones(FRAMES, bool)
    )


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    clips.save(folder / "train", [dyad("a", 0)])
    clips.save(folder / "validation", [dyad("b", 1)])
    return folder


def tiny() -> dict:
    phase = {"steps": 6, "batch": 4, "learning_rate": 0.005, "evaluate_every": 3}
    return {
        "seed": 2,
        "listener": {
            "kind": "sfms",
            "placement": "static",
            "groups": {
                "neck": {"channels": list(POSE_CHANNELS), "levels": [3, 3], "keyframes": 6},
                "face": {"channels": list(BLENDSHAPES), "levels": [3, 3], "keyframes": 6},
            },
            "tokenizer_width": 8,
            "predictor_width": 8,
            "predictor_layers": 1,
            "heads": 2,
        },
        "tokenizer": dict(phase),
        "predictor": phase | {"calibration_rounds": 0},
    }


@pytest.fixture
def arguments(tmp_path, data):
    """Flags of a tiny training, the changed configuration written to a file."""

    def write(raw=None) -> list[str]:
        file = tmp_path / "tiny.yaml"
        file.write_text(yaml.safe_dump(raw or tiny(), sort_keys=False))
        return ["--config", str(file), "--data", str(data), "--out", str(tmp_path / "out"), "--device", "cpu"]

    return write


@pytest.fixture
def fails(command_line):
    """Run a command line that must fail; gives exit code and the one line on stderr."""

    def run(*words: str) -> tuple[object, str]:
        ended = command_line("train", *words)
        told = [line for line in ended.err.splitlines() if line.startswith("sfms-robot:")]
        assert len(told) == 1, told
        return ended.code, told[0]

    return run


@pytest.fixture
def done(command_line):
    """Run a `train` command that ends well; figures and stderr."""

    def run(*words: str) -> tuple[dict, str]:
        ended = command_line("train", *words, "--json")
        assert ended.code == 0
        return ended.told, ended.err

    return run


def test_both_phases_give_figures_and_a_folder_that_runs(done, arguments, tmp_path):
    first, bar = done("tokenizer", *arguments(), "--no-tensorboard")
    assert first["steps"] == 6 and first["mse"] > 0 and first["stopped"] == "steps" and "loss" in bar
    second, _ = done("listener", *arguments(), "--no-tensorboard", "--steps", "4")
    assert second["steps"] == 4 and second["held_out_loss"] > 0
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"config.yaml", "tokenizer.safetensors", "model.safetensors"} <= names
    assert {"checkpoint-tokenizer.safetensors", "checkpoint-listener.safetensors"} <= names
    assert "tensorboard" not in names


def test_both_phases_train_in_16_bits(done, arguments, monkeypatch):
    monkeypatch.setattr("torch.cpu._is_avx512_bf16_supported", lambda: True)
    raw = tiny()
    for phase in ("tokenizer", "predictor"):
        raw[phase] |= {"precision": "bf16", "steps": 2}
        command = "listener" if phase == "predictor" else phase
        figures, _ = done(command, *arguments(raw), "--no-tensorboard")
        assert figures["steps"] == 2


def test_curves_go_to_tensorboard(done, arguments, tmp_path):
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    done("tokenizer", *arguments(), "--tensorboard")
    curves = events.EventAccumulator(str(tmp_path / "out" / "tensorboard" / "tokenizer"))
    curves.Reload()
    assert {"loss", "held_out_loss", "learning_rate", "frames_per_s"} <= set(curves.Tags()["scalars"])
    assert [point.step for point in curves.Scalars("held_out_loss")] == [3, 6]


def test_curves_that_were_asked_for_name_the_missing_extra(arguments):
    without = f"import sys; sys.modules['tensorboard'] = None; {START}"
    command = [sys.executable, "-c", without, "train", "tokenizer", *arguments(), "--tensorboard"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert (
        ended.stderr
        == "sfms-robot: --tensorboard needs tensorboard, which is not installed: pip install 'sfms-robot[train]'\n"
    )


def test_a_finished_run_says_so(done, arguments):
    before, _ = done("tokenizer", *arguments(), "--no-tensorboard")
    after, told = done("tokenizer", *arguments(), "--no-tensorboard", "--resume")
    assert "had already finished at step 6" in told
    assert after["mse"] == before["mse"] and after["resumed_at"] == 6


def test_nothing_to_resume(fails, arguments):
    code, told = fails("tokenizer", *arguments(), "--resume")
    assert code == 2 and "checkpoint-tokenizer.safetensors: no checkpoint to resume from" in told


def test_an_earlier_training_is_not_lost_unasked(done, fails, arguments, tmp_path):
    done("tokenizer", *arguments(), "--no-tensorboard")
    weights = tmp_path / "out" / "tokenizer.safetensors"
    before = weights.read_bytes()
    code, told = fails("tokenizer", *arguments(), "--steps", "3")
    assert code == 2 and f"{weights} is of an earlier training: --resume continues it, --overwrite" in told
    assert weights.read_bytes() == before
    weights.unlink()
    code, told = fails("tokenizer", *arguments(), "--steps", "3")
    assert code == 2 and "checkpoint-tokenizer.safetensors is of an earlier training" in told
    anew, _ = done("tokenizer", *arguments(), "--no-tensorboard", "--steps", "3", "--overwrite")
    assert anew["steps"] == 3 and weights.exists()


@pytest.mark.parametrize("name", ["model.safetensors", "config.yaml"])
def test_a_tokenizer_is_not_trained_into_the_folder_of_a_listener(fails, arguments, tmp_path, name):
    """Its configuration would be replaced, and what was calibrated lost."""
    (tmp_path / "out").mkdir(exist_ok=True)
    (tmp_path / "out" / name).write_bytes(b"whole")
    code, told = fails("tokenizer", *arguments())
    assert code == 2 and f"{name} is of an earlier training" in told
    assert [file.read_bytes() for file in (tmp_path / "out").iterdir()] == [b"whole"]


def test_a_checkpoint_of_another_configuration(done, fails, arguments):
    done("tokenizer", *arguments(), "--no-tensorboard")
    raw = tiny()
    raw["listener"]["tokenizer_width"] = 16
    code, told = fails("tokenizer", *arguments(raw), "--resume")
    assert code == 2 and "listener.tokenizer_width = 8 there, 16 now" in told


def test_phase_2_without_phase_1(fails, arguments):
    code, told = fails("listener", *arguments())
    assert code == 5 and "tokenizer.safetensors: no such weights file" in told


def test_ctrl_c_saves_says_how_to_go_on_and_exits_130(arguments, tmp_path):
    raw = tiny()
    raw["tokenizer"] |= {"steps": 1_000_000, "checkpoint_every": 5}
    command = [sys.executable, "-c", START, "train", "tokenizer", *arguments(raw), "--no-tensorboard"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as running:
        while not (tmp_path / "out" / "checkpoint-tokenizer.safetensors").exists():
            with pytest.raises(subprocess.TimeoutExpired):  # it runs on
                running.wait(timeout=0.1)
        running.send_signal(signal.SIGINT)
        told = running.communicate()[1]
    assert running.returncode == 130
    assert "tokenizer: interrupted after step" in told and "of 1000000" in told and "--resume continues" in told
    assert "Traceback" not in told
    assert not (tmp_path / "out" / "tokenizer.safetensors").exists()


WRONG = [
    ("tokenizer.steps", 0, "tokenizer.steps = 0"),
    ("tokenizer.steps", "many", "tokenizer.steps = 'many'"),
    ("tokenizer.batch", 1.5, "tokenizer.batch = 1.5"),
    ("tokenizer.learning_rate", -1, "tokenizer.learning_rate = -1"),
    ("tokenizer.learning_rate", float("nan"), "tokenizer.learning_rate = nan"),
    ("tokenizer.score_learning_rate", 0, "tokenizer.score_learning_rate = 0"),
    ("tokenizer.weight_decay", -0.1, "tokenizer.weight_decay = -0.1"),
    ("tokenizer.warm_up_steps", -1, "tokenizer.warm_up_steps = -1"),
    ("tokenizer.clip_norm", 0, "tokenizer.clip_norm = 0"),
    ("tokenizer.precision", "fp16", "tokenizer.precision = 'fp16': Input should be 'fp32' or 'bf16'"),
    ("tokenizer.evaluate_every", -1, "tokenizer.evaluate_every = -1"),
    ("tokenizer.patience", 0, "tokenizer.patience = 0"),
    ("tokenizer.checkpoint_every", 0, "tokenizer.checkpoint_every = 0"),
    ("tokenizer.checkpoint_minutes", 0, "tokenizer.checkpoint_minutes = 0"),
    ("tokenizer.mask_loss", -1, "tokenizer.mask_loss = -1"),
    ("tokenizer.velocity_loss", -1, "tokenizer.velocity_loss = -1"),
    ("tokenizer.temperature", [2.0], "tokenizer.temperature"),
    ("tokenizer.temperature", [2.0, 0.0], "tokenizer.temperature.1 = 0.0"),
    ("tokenizer.stpes", 5, "'stpes' is not a known key (steps, batch,"),
    ("predictor.transition_weight", 0, "predictor.transition_weight = 0"),
    ("predictor.neutral_prefix", 1.1, "predictor.neutral_prefix = 1.1"),
    ("predictor.drop_audio", -1, "predictor.drop_audio = -1"),
    ("predictor.drop_face", 2, "predictor.drop_face = 2"),
    ("predictor.history_noise", 2, "predictor.history_noise = 2"),
    ("predictor.gain_db", -6, "predictor.gain_db = -6"),
    (
        "predictor.group_weights",
        {"chin": 2},
        "predictor.group_weights: 'chin' is not a group of the listener (neck, face)",
    ),
    ("predictor.group_weights", {"neck": 0}, "predictor.group_weights.neck = 0"),
    ("predictor.calibration_rounds", -1, "predictor.calibration_rounds = -1"),
    ("seed", -1, "seed = -1"),
    ("listener.kind", "other", "listener.kind = 'other'"),
    ("predictor", None, "predictor"),
]


@pytest.mark.parametrize(("key", "value", "told"), WRONG, ids=[f"{key}={value}" for key, value, _ in WRONG])
def test_a_wrong_training_key_is_one_line(fails, arguments, key, value, told):
    raw = tiny()
    *path, last = key.split(".")
    where = raw[path[0]] if path else raw
    where[last] = value
    code, line = fails("tokenizer", *arguments(raw))
    assert code == 2 and told in line and "tiny.yaml" in line


def test_patience_without_looking(fails, arguments):
    raw = tiny()
    raw["tokenizer"] |= {"evaluate_every": 0, "patience": 3}
    code, line = fails("tokenizer", *arguments(raw))
    assert code == 2 and "patience 3 needs evaluate_every above 0" in line


def test_the_shipped_configuration_is_valid():
    from sfms_robot import config

    for file in (data_dir("configs") / "training").glob("sfms-*.yaml"):
        assert config.load(config.Training, file).tokenizer.steps > 0


def test_an_order_of_channels_where_there_is_none_to_choose(fails, arguments):
    code, told = fails("tokenizer", *arguments(), "--order", "pose-first")
    assert code == 2 and "--order pose-first: composed files name their channels" in told


def test_a_gpu_that_is_not_there(fails, arguments):
    import torch

    if torch.cuda.is_available():
        pytest.skip("there is one")
    code, line = fails("tokenizer", *arguments(), "--device", "cuda")
    assert code == 2 and "--device cuda: torch sees no CUDA device here (auto, cpu)" in line


def test_the_interrupt_handler_survives_a_training(done, arguments):
    before = signal.getsignal(signal.SIGINT)
    done("tokenizer", *arguments(), "--no-tensorboard")
    assert signal.getsignal(signal.SIGINT) is before
