"""On a random model of the real architecture, three hundred times smaller."""

import json

import numpy as np
import pytest

from sfms_robot.errors import MissingExtra, ModelError
from sfms_robot.signals import wav2vec2

NOISE = np.random.default_rng(0).normal(0, 0.1, 16_000).astype(np.float32)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    transformers = pytest.importorskip("transformers")
    place = tmp_path_factory.mktemp("tiny")
    tiny = transformers.Wav2Vec2Config(
        hidden_size=16, num_hidden_layers=2, num_attention_heads=2, intermediate_size=32, conv_dim=(8,) * 7,
        num_conv_pos_embeddings=16, num_conv_pos_embedding_groups=2,
    )  # fmt: skip
    transformers.Wav2Vec2Model(tiny).save_pretrained(place)
    (place / "preprocessor_config.json").write_text(json.dumps({"do_normalize": True}))
    return place


@pytest.fixture(scope="module")
def model(folder):
    return wav2vec2.Wav2Vec2(folder)


@pytest.mark.parametrize("cuts", [[640] * 25, [100, 5000, 640, 1], [16_000], []])
def test_stream_equals_offline_for_any_chunking(model, cuts):
    whole = model.of_recording(NOISE)
    first = past = model.start()
    rows, at = [], 0
    for size in [*cuts, len(NOISE)]:
        new, past = model.step(NOISE[at : at + size], past)
        rows.append(new)
        at += size
    np.testing.assert_allclose(np.concatenate(rows), whole, atol=1e-4)
    assert whole.shape == (25, 16) and len(past) >= len(first) and not first.any()


@pytest.mark.parametrize("hop", [2, 8])
def test_a_hop_of_frames_streams_as_it_is_offline(folder, hop):
    hopping = wav2vec2.Wav2Vec2(folder, hop_frames=hop)
    whole = hopping.of_recording(NOISE)
    past, rows = hopping.start(), []
    for at in range(0, len(NOISE), 1000):
        new, past = hopping.step(NOISE[at : at + 1000], past)
        assert len(new) % hop == 0
        rows.append(new)
    streamed = np.concatenate(rows)
    assert whole.shape == (25, 16) and len(streamed) == 25 // hop * hop
    np.testing.assert_allclose(streamed, whole[: len(streamed)], atol=1e-4)
    with pytest.raises(ValueError, match="needs data at 25 fps, not 30"):
        hopping.of_recording(NOISE, fps=30)


def test_rows_forget_2_s_ago_come_at_the_rate_of_the_data_and_do_not_depend_on_loudness(model):
    long = np.concatenate([NOISE, NOISE, NOISE, NOISE])
    np.testing.assert_allclose(model.of_recording(long)[60:75], model.of_recording(long[640 * 9 :])[51:66], atol=1e-4)
    assert model.of_recording(NOISE, fps=30).shape == (30, 16)
    np.testing.assert_allclose(model.of_recording(NOISE)[-1], model.of_recording(0.2 * NOISE)[-1], atol=1e-2)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (None, "config.json: no such file: a model folder holds config.json and model.safetensors"),
        ("{", "config.json: not JSON"),
        ("[]", "config.json: not a table"),
        ('{"model_type": "bert"}', "model_type = 'bert' is not wav2vec2"),
        ('{"model_type": "wav2vec2"}', "no wav2vec2 weights that can be read"),
    ],
)
def test_folder_that_is_no_model_is_one_clear_line(tmp_path, config, message):
    pytest.importorskip("transformers")
    if config is not None:
        (tmp_path / "config.json").write_text(config)
    with pytest.raises(ModelError, match=message):
        wav2vec2.Wav2Vec2(tmp_path)


def test_missing_extra_names_the_install(monkeypatch, tmp_path):
    monkeypatch.setitem(__import__("sys").modules, "transformers", None)
    with pytest.raises(MissingExtra, match=r"pip install -e '.*\[wav2vec2\]'"):
        wav2vec2.Wav2Vec2(tmp_path)
