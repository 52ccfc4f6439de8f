"""What a GPU needs of training: noise of its own, no step that waits, memory that runs out. No test needs one."""

import json
import math

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from test_training_loop import same, toy, weights
from tiny_arig_training import settings, write
from tiny_sfms_training import configuration

from sfms_robot.errors import ConfigError, ModelError
from sfms_robot.lab.learning.arig.features import fit_scales, gather, open_scenes
from sfms_robot.lab.learning.arig.trainer import Student, augment, decayed, loss_parts, state_loss, train_arig
from sfms_robot.lab.learning.corpus import Corpus
from sfms_robot.lab.learning.job import OwnNoise, Run, noise_of
from sfms_robot.lab.learning.train_runs import TrainOptions, pack_data, train_listener
from sfms_robot.lab.learning.training_loop import READ_EVERY, checkpoint_file, fit, peek
from sfms_robot.listeners.arig.model import ArigModel
from sfms_robot.listeners.space import MotionSpace

TOLD = {"events": True, "draws": "innovation", "sway": True}
NOISY = {"quiet_room": 0.5, "silent_user": 0.2, "history_noise": 1.5, "event_windows": 0.5}
SILENT = {"history_noise": 0.0, "speaking_noise": 0.0, "state_noise": 0.0} | {
    name: 0.0 for name in "drop_audio drop_face drop_agent gain_db colour_db grain_db".split()
}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write(tmp_path_factory.mktemp("data"))


def test_a_cpu_run_is_what_it_was_before_noise_could_be_drawn_elsewhere(data, tmp_path):
    """The losses of version 0.2.0.dev0, whose noise all came from one generator on the CPU."""
    losses = []
    whole = settings(TOLD, steps=8, group_weights={"head": 1.5, "mouth": 2.0}, **NOISY)
    train_arig(whole, data, tmp_path, Run(watches=(lambda report: losses.append(report.loss),)))
    assert losses[:3] == pytest.approx([15.720572, 11.536802, 13.947612], rel=1e-4)


def test_the_noise_of_a_cpu_is_the_runs_own_and_of_weight_zero_not_drawn_on_a_gpu(data):
    generator = torch.Generator().manual_seed(1)
    assert noise_of(generator, torch.device("cpu")) is generator
    _, _, after = step_of(data, SILENT, "cpu")
    assert torch.equal(after, OwnNoise("cpu").manual_seed(3).get_state())
    _, _, after = step_of(data, NOISY, "cpu")
    assert not torch.equal(after, OwnNoise("cpu").manual_seed(3).get_state())


def step_of(data, phase, device):
    """Return one step's loss as a GPU makes it, and the generator of its noise, of numbers on `device`."""
    whole = settings(TOLD, **phase)
    corpus = gather(open_scenes(data, "train"), 24, MotionSpace("arkit58", np.zeros(58)), whole.listener)
    student = Student(ArigModel(whole.listener))
    fit_scales(student.model, corpus)
    dyad = corpus.cut(torch.tensor([0, 30]), 24)
    student.to(device)
    dyad = Corpus(dyad, (48,), ("listening",)).to(device).frames
    noise = OwnNoise("cpu").manual_seed(3)
    told, truth = augment(dyad, student.model, whole.training, noise)
    before = noise.get_state()
    return loss_parts(student, told, dyad.states, truth, whole.training, noise).total(whole.training), noise, before


@pytest.mark.parametrize("phase", [SILENT, NOISY, {"group_weights": {"head": 2.0}}])
def test_nothing_in_a_step_waits_for_the_device(data, phase):
    """On torch's device `meta`, which has no values: whatever looks at one raises."""
    loss, _, _ = step_of(data, phase, "meta")
    loss.backward()
    assert loss.device.type == "meta"


def test_labelled_frames_and_decays_are_the_same_at_once():
    logits, states = torch.randn(3, 20, 7), torch.randint(-1, 7, (3, 20))
    torch.testing.assert_close(state_loss(logits, states, selected=False), state_loss(logits, states))
    assert state_loss(logits, torch.full_like(states, -1), selected=False) == 0
    jumps = torch.randn(2, 30, 5)
    torch.testing.assert_close(decayed(jumps, at_once=True), decayed(jumps))


@pytest.mark.parametrize("every", [2, READ_EVERY])
def test_losses_that_are_read_together_change_no_weight_and_no_report(tmp_path, every):
    reports = {1: [], every: []}
    for each, found in reports.items():
        job = toy(evaluate_every=5)
        fit(job, tmp_path / str(each), Run(read_every=each, watches=(lambda report, to=found: to.append(report),)))
        found.append(weights(job))
    one, several = reports[1], reports[every]
    assert same(one.pop(), several.pop())
    assert [(report.position, report.loss, report.looked) for report in one] == [
        (report.position, report.loss, report.looked) for report in several
    ]


def test_a_loss_that_is_not_finite_is_found_when_it_is_read(tmp_path):
    job = toy(loss=lambda step, loss: loss * (math.nan if step >= 7 else 1), checkpoint_every=5, evaluate_every=0)
    with pytest.raises(ModelError, match=r"toy: loss nan.* at step 7: not finite \(.* holds step 5\)"):
        fit(job, tmp_path, Run(read_every=4))


@pytest.mark.parametrize("every", [1, 4])
def test_a_gpu_without_memory_keeps_the_steps_made_so_far(tmp_path, every):
    def short(step, loss):
        if step == 7:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB.\nSee documentation")
        return loss

    with pytest.raises(ModelError) as ended:
        fit(toy(loss=short, evaluate_every=0), tmp_path, Run(read_every=every))
    assert "\n" not in str(ended.value) and "for a batch of 4 at step 7: begin with --accumulate 2 or more" in str(
        ended.value
    )
    assert peek(checkpoint_file(tmp_path, "toy"))[0].step == 7
    assert fit(toy(evaluate_every=0), tmp_path, Run(resume=True)).steps == 12


@pytest.fixture(scope="module")
def pack(data, tmp_path_factory):
    """Return a training file and the pack of its data."""
    folder = tmp_path_factory.mktemp("pack")
    (folder / "told.yaml").write_text(json.dumps(settings(TOLD).model_dump(mode="json")))
    found = pack_data(folder / "told.yaml", data, folder / "told.pack")
    assert found["train"] == {"dyads": 6, "frames": 1800} and found["bytes"] > 1e6
    return folder / "told.yaml", folder / "told.pack"


def test_a_pack_trains_what_its_folder_trains(data, pack, tmp_path):
    trained = [train_arig(settings(TOLD), place, tmp_path / place.name) for place in (data, pack[1])]
    assert trained[0] == trained[1]
    one, two = ((tmp_path / place.name / "model.safetensors").read_bytes() for place in (data, pack[1]))
    assert one == two


def test_a_pack_of_another_version_or_listener_or_no_pack_is_refused_in_one_line(pack, tmp_path):
    old = tmp_path / "old.pack"
    save_file({"x": torch.zeros(1)}, old, {"pack": '{"version": 7}'})
    with pytest.raises(ConfigError, match="^.*old.pack: version: expected 1, got 7; pack again: .*train pack$"):
        train_arig(settings(TOLD), old, tmp_path / "out")
    with pytest.raises(ConfigError, match="^.*told.pack: events: expected False, got True; pack again"):
        train_arig(settings(), pack[1], tmp_path / "out")
    with pytest.raises(ConfigError, match="^.*told.yaml: not a pack of training data"):
        train_arig(settings(TOLD), pack[0], tmp_path / "out")


def test_a_pack_holds_nothing_to_calibrate_with(pack, tmp_path):
    file, raw = tmp_path / "sfms.yaml", configuration()
    raw["predictor"]["calibration_rounds"] = 2
    file.write_text(json.dumps(raw))
    with pytest.raises(ConfigError, match="calibration_rounds: expected 0 of them, or the folder as --data"):
        train_listener(TrainOptions(file=file, data=pack[1], out=tmp_path / "out"))
