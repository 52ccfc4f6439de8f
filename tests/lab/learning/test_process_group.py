"""Several processes train what one process trains: same losses, whoever takes a piece, and whoever dies."""

import json
import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tiny_arig_training

import sfms_robot
from sfms_robot.errors import ConfigError
from sfms_robot.lab.learning.arig.trainer import train_arig
from sfms_robot.lab.learning.job import ProcessGroup, Run
from sfms_robot.lab.learning.training_loop import checkpoint_file, peek

TESTS = Path(tiny_arig_training.__file__).parent
ENVIRONMENT = {
    **os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": f"{Path(sfms_robot.__file__).parents[1]}:{TESTS}",
}  # fmt: skip
SAME = 1e-4  # of a loss, between one process and several: sums are taken in another order


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return tiny_arig_training.write(tmp_path_factory.mktemp("conversations"))


def train(processes: int, *words: str, **given) -> subprocess.CompletedProcess:
    started = [sys.executable]
    if processes > 1 or words:
        started += ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={processes}", *words]
    told = json.dumps({"steps": 8, **{key: str(v) if isinstance(v, Path) else v for key, v in given.items()}})
    return subprocess.run(
        [*started, str(TESTS / "group_worker.py"), told], env=ENVIRONMENT, capture_output=True, text=True, timeout=300
    )


def trained(processes: int, *words: str, **given) -> dict:
    done = train(processes, *words, **given)
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads((Path(given["out"]) / "losses.json").read_text())


@pytest.fixture(scope="module")
def alone(data, tmp_path_factory):
    """One process that takes both pieces of every step."""
    return trained(1, data=data, out=tmp_path_factory.mktemp("alone"), accumulate=2)


@pytest.mark.slow
def test_two_processes_have_the_losses_of_one_also_staged_on_disk_and_their_run_goes_on_in_one(data, tmp_path, alone):
    out = tmp_path / "out"
    whole = trained(2, data=data, out=out, scratch=tmp_path / "scratch", every=4)
    np.testing.assert_allclose(whole["losses"], alone["losses"], rtol=SAME)
    assert whole["held_out"] == pytest.approx(alone["held_out"], rel=SAME)
    assert list((tmp_path / "scratch").rglob("user_sound.frames"))

    half = tmp_path / "half"
    assert train(2, data=data, out=half, every=4, dies_at=5).returncode != 0
    assert peek(checkpoint_file(half, "arig"))[0].step == 4, "the last checkpoint stands"
    rest = trained(1, data=data, out=half, resume=True)
    assert rest["resumed_at"] == 4
    np.testing.assert_allclose(rest["losses"], alone["losses"][4:], rtol=SAME)


@pytest.mark.slow
def test_what_torchrun_starts_again_goes_on_from_the_checkpoint(data, tmp_path, alone):
    again = trained(2, "--max-restarts=1", data=data, out=tmp_path, every=3, dies_at=5)
    assert again["resumed_at"] == 3
    np.testing.assert_allclose(again["losses"], alone["losses"][3:], rtol=SAME)


def settings(**phase):
    return tiny_arig_training.settings(steps=2, batch=4, **phase)


@pytest.mark.parametrize(
    ("size", "accumulate", "said"), [(3, None, "batch of 4 cannot be cut into 3 pieces"), (2, 4, "cut into 8 pieces")]
)
def test_a_batch_that_cannot_be_shared_is_refused(data, tmp_path, size, accumulate, said):
    with pytest.raises(ConfigError, match=said):
        train_arig(settings(), data, tmp_path, Run(group=ProcessGroup(size=size), accumulate=accumulate))


def test_pieces_are_part_of_a_run_and_processes_that_cannot_share_them_are_told_who_can(data, tmp_path):
    train_arig(settings(), data, tmp_path, Run(accumulate=4))
    assert peek(checkpoint_file(tmp_path, "arig"))[1] == 4
    with pytest.raises(ConfigError, match=r"4 pieces; 3 processes cannot share them \(1, 2, 4 can\)"):
        train_arig(settings(), data, tmp_path, Run(resume=True, group=ProcessGroup(size=3)))
    with pytest.raises(ConfigError, match="begun with 4 pieces a step, --accumulate 2 makes 2"):
        train_arig(settings(), data, tmp_path, Run(resume=True, accumulate=2))


def test_a_disk_that_is_full_leaves_the_last_checkpoint_and_says_so(data, tmp_path):
    """A limit on the size of files stands for the disk."""
    train_arig(settings(), data, tmp_path, Run())
    file = checkpoint_file(tmp_path, "arig")
    before, limits = file.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with pytest.raises(ConfigError, match=r"checkpoint-arig.safetensors: cannot be written"):
            train_arig(settings(), data, tmp_path, Run())
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert file.read_bytes() == before
    assert not list(tmp_path.glob("*.part"))
