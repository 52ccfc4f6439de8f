import tracemalloc

import numpy as np
import pytest
import torch
from safetensors.numpy import save_file as save_numpy
from safetensors.torch import load_file, save_file
from tiny_sfms import plans_of, speech

from sfms_robot.errors import ConfigError, ModelError
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.registry import load_folder


@pytest.fixture
def folder(tmp_path, tiny):
    checkpoint.save_config(tmp_path, tiny.settings)
    checkpoint.save_weights(tmp_path / checkpoint.WEIGHTS, tiny.model)
    return tmp_path


def test_a_saved_listener_plans_as_before(folder, tiny):
    loaded = load_folder(folder)
    assert loaded.settings == tiny.settings
    speaker = speech(9)
    for index, plan in plans_of(loaded, speaker).items():
        assert (plan.frames == plans_of(tiny, speaker)[index].frames).all()


def test_missing_files_are_named(folder):
    (folder / "model.safetensors").unlink()
    with pytest.raises(ModelError, match=r"model\.safetensors: no such weights file"):
        load_folder(folder)
    (folder / "config.yaml").unlink()
    with pytest.raises(ConfigError, match=r"config\.yaml: no such file"):
        load_folder(folder)


@pytest.mark.parametrize("size", [0, 7, 200])
def test_corrupt_weights_are_named(folder, size):
    file = folder / "model.safetensors"
    file.write_bytes(file.read_bytes()[:size])
    with pytest.raises(ModelError, match=r"model\.safetensors: not a readable safetensors file"):
        load_folder(folder)


def _rewrite(folder, change):
    file = folder / "model.safetensors"
    tensors = load_file(file)
    change(tensors)
    save_file(tensors, file)


SLOTS = "predictor.slots"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda tensors: tensors.pop(SLOTS), "tensor predictor.slots is missing"),
        (lambda tensors: tensors.update(stray=torch.zeros(1)), "tensor stray is not part of the configured model"),
        (lambda tensors: tensors["motion_mean"].fill_(torch.nan), "motion_mean holds values that are not finite"),
        (lambda tensors: tensors[SLOTS].fill_(1e30), r"slots holds 1e\+30, no trained model is above 1e\+06"),
        (lambda tensors: tensors.update({SLOTS: tensors[SLOTS].int()}), "slots is of int32, the model needs float32"),
        (lambda tensors: tensors.update({SLOTS: torch.zeros(8, 5)}), r"shape \(8, 5\), the configuration needs"),
    ],
)
def test_a_tensor_that_does_not_fit_is_named(folder, change, said):
    _rewrite(folder, change)
    with pytest.raises(ModelError, match=said):
        load_folder(folder)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_any_float_will_do(folder, dtype):
    _rewrite(folder, lambda tensors: tensors.update({"predictor.slots": tensors["predictor.slots"].to(dtype)}))
    assert next(iter(load_folder(folder).model.parameters())).dtype == torch.float32


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


def matrices(seed=0):
    draw = np.random.default_rng(seed)
    large = draw.normal(0, 1, (96, 128)).astype(np.float32) * draw.uniform(1e-3, 10, (96, 1)).astype(np.float32)
    large[7] = 0
    kernels = draw.normal(0, 0.1, (96, 32, 5)).astype(np.float32)
    return {"large": large, "kernels": kernels, "small": draw.normal(size=(8, 6)).astype(np.float32),
            "row": draw.normal(size=9000).astype(np.float32), "number": np.float32(0.3).reshape(()),
            "count": np.arange(9000).reshape(90, 100)}  # fmt: skip


def test_large_matrices_in_8_bits_are_off_by_half_a_step_of_their_row_and_all_else_by_nothing(tmp_path):
    wanted = matrices()
    checkpoint.write_tensors(tmp_path / "a.safetensors", wanted, 8)
    shapes = {name: (value.shape, value.dtype.kind == "f") for name, value in wanted.items()}
    found = dict(checkpoint.stored_tensors(tmp_path / "a.safetensors", shapes))
    assert found.keys() == wanted.keys()
    for name, value in wanted.items():
        assert found[name].shape == value.shape
        if name in ("large", "kernels"):
            rows, off = (each.reshape(96, -1) for each in (value, found[name] - value))
            assert 0 < np.abs(off).max() and (np.abs(off).max(1) <= np.abs(rows).max(1) / 253).all()
        else:
            np.testing.assert_array_equal(found[name], value)
    left = sum(value.nbytes for value in wanted.values()) - (tmp_path / "a.safetensors").stat().st_size
    assert left > 0.7 * (wanted["large"].nbytes + wanted["kernels"].nbytes)


def test_written_in_8_bits_again_they_are_the_same_and_what_16_bits_do_not_hold_stays_in_32(tmp_path):
    for before, after in (("a", "b"), ("b", "c")):
        if before == "a":
            checkpoint.write_tensors(tmp_path / "a", matrices(), 8)
        checkpoint.write_tensors(tmp_path / after, checkpoint.read_weights(tmp_path / before), 8)
    assert (tmp_path / "b").read_bytes() == (tmp_path / "c").read_bytes()
    checkpoint.write_tensors(tmp_path / "a", {"far": np.array([1e5, 1.0], np.float32), "none": np.zeros((0, 3))}, 16)
    np.testing.assert_array_equal(checkpoint.read_weights(tmp_path / "a")["far"], [1e5, 1.0])


@pytest.mark.parametrize(
    ("scale", "told"),
    [
        (None, "tensor large is of int8, the model needs float32"),
        (np.ones(5, np.float32), r"tensor large\.row_scale is not \(96,\) real numbers"),
        (np.ones(96, np.int64), r"tensor large\.row_scale is not \(96,\) real numbers"),
        (np.full(96, np.nan, np.float32), "tensor large holds values that are not finite"),
        (np.full(96, 1e38, np.float32), "tensor large holds values that are not finite"),
        (np.full(96, 1e5, np.float32), r"tensor large holds 1\.27e\+07, no trained model is above 1e\+06"),
    ],
)
def test_a_scale_of_rows_that_is_wrong_is_named(scale, told, tmp_path):
    tensors = {"large": np.full((96, 128), 127, np.int8)} | ({} if scale is None else {"large.row_scale": scale})
    save_numpy(tensors, tmp_path / "a.safetensors")
    with pytest.raises(ModelError, match=told):
        dict(checkpoint.stored_tensors(tmp_path / "a.safetensors", {"large": ((96, 128), True)}))
