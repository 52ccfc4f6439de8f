import tracemalloc

import numpy as np
import pytest
import torch
from safetensors.numpy import save_file as save_numpy
from safetensors.torch import load_file, save_file
from tiny_sfms import plans_of, speech, tiny_listener, tiny_settings

from sfms_robot.errors import ConfigError, ModelError
from sfms_robot.listeners import checkpoint, sfms
from sfms_robot.listeners.sfms.model import SfmsModel


@pytest.fixture
def folder(tmp_path, tiny):
    checkpoint.save_config(tmp_path, tiny.settings)
    checkpoint.save_weights(tmp_path / checkpoint.WEIGHTS, tiny.model)
    return tmp_path


def test_a_saved_listener_plans_as_before(folder, tiny):
    loaded = sfms.load(folder)
    assert loaded.settings == tiny.settings
    speaker = speech(9)
    for index, plan in plans_of(loaded, speaker).items():
        assert (plan.frames == plans_of(tiny, speaker)[index].frames).all()


def test_missing_files_are_named(folder):
    (folder / "model.safetensors").unlink()
    with pytest.raises(ModelError, match=r"model\.safetensors: no such weights file"):
        sfms.load(folder)
    (folder / "config.yaml").unlink()
    with pytest.raises(ConfigError, match=r"config\.yaml: no such file"):
        sfms.load(folder)


@pytest.mark.parametrize("size", [0, 7, 200])
def test_corrupt_weights_are_named(folder, size):
    file = folder / "model.safetensors"
    file.write_bytes(file.read_bytes()[:size])
    with pytest.raises(ModelError, match=r"model\.safetensors: not a readable safetensors file"):
        sfms.load(folder)


def _rewrite(folder, change):
    file = folder / "model.safetensors"
    tensors = load_file(file)
    change(tensors)
    save_file(tensors, file)


def test_a_missing_tensor_is_named(folder):
    _rewrite(folder, lambda tensors: tensors.pop("predictor.slots"))
    with pytest.raises(ModelError, match="tensor predictor.slots is missing"):
        sfms.load(folder)


def test_a_tensor_too_many_is_named(folder):
    _rewrite(folder, lambda tensors: tensors.update(stray=torch.zeros(1)))
    with pytest.raises(ModelError, match="tensor stray is not part of the configured model"):
        sfms.load(folder)


def test_a_tensor_that_is_not_finite_is_named(folder):
    _rewrite(folder, lambda tensors: tensors["motion_mean"].fill_(float("nan")))
    with pytest.raises(ModelError, match="tensor motion_mean holds values that are not finite"):
        sfms.load(folder)


@pytest.mark.parametrize("factor", [1e30, 1e38])
def test_weights_that_would_overflow_are_named(folder, factor):
    _rewrite(folder, lambda tensors: tensors["predictor.slots"].fill_(factor))
    with pytest.raises(ModelError, match=r"tensor predictor.slots holds 1e\+.*, no trained model is above 1e\+06"):
        sfms.load(folder)


@pytest.mark.parametrize("dtype", [torch.int32, torch.bool])
def test_weights_that_are_no_floats_are_named(folder, dtype):
    _rewrite(folder, lambda tensors: tensors.update({"predictor.slots": tensors["predictor.slots"].to(dtype)}))
    with pytest.raises(ModelError, match=f"tensor predictor.slots is of {str(dtype)[6:]}, the model needs float32"):
        sfms.load(folder)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_any_float_will_do(folder, dtype):
    _rewrite(folder, lambda tensors: tensors.update({"predictor.slots": tensors["predictor.slots"].to(dtype)}))
    assert next(iter(sfms.load(folder).model.parameters())).dtype == torch.float32


def test_a_folder_that_cannot_be_written_is_one_line_and_nothing_is_left(tmp_path, tiny):
    (tmp_path / "file").write_text("in the way")
    for write in (
        lambda: checkpoint.save_config(tmp_path / "file" / "x", tiny.settings),
        lambda: checkpoint.save_weights(tmp_path / "file" / "x" / "model.safetensors", tiny.model),
        lambda: checkpoint.save_weights(tmp_path, tiny.model),
    ):
        with pytest.raises(ModelError, match="cannot be written") as caught:
            write()
        assert "\n" not in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_weights_of_another_configuration_are_told_by_their_shapes(folder):
    checkpoint.save_config(folder, tiny_settings(predictor_width=32))
    with pytest.raises(ModelError, match=r"tensor predictor\.\S+ has shape \(.*16.*\), the configuration needs \(.*32"):
        sfms.load(folder)


def test_a_learned_placement_carries_its_scores(tmp_path):
    listener = tiny_listener(placement="learned")
    names = listener.model.state_dict()
    assert any(name.startswith("tokenizer.score.") for name in names)
    assert not any(name.startswith("tokenizer.score.") for name in SfmsModel(tiny_settings()).state_dict())


def test_tensors_are_read_one_at_a_time(tmp_path):
    """Whoever keeps none of them needs memory for one."""
    megabyte = np.zeros(2**18, np.float32)
    save_numpy({f"layer{index}": megabyte + index for index in range(12)}, tmp_path / "weights.safetensors")
    tracemalloc.start()
    try:
        seen = [(name, float(value[0])) for name, value in checkpoint.stored_tensors(tmp_path / "weights.safetensors")]
        peak_bytes = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert dict(seen) == {f"layer{index}": index for index in range(12)}
    assert peak_bytes < 5 * megabyte.nbytes
