import numpy as np
import pytest
from tiny_arig import RAW, arig_listener, talk

from sfms_robot.config.listener import parse_listener
from sfms_robot.errors import ConfigError
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.registry import load_folder


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"width": 20, "heads": 4}, "width 20 is not a multiple of twice heads"),
        ({"diffusion": {"steps": 2000}}, "steps 2000 is above train_steps 1000"),
        ({"diffusion": {"width": 9}}, "diffusion.width = 9"),
        ({"diffusion": {"sampler": "euler"}}, "diffusion.sampler = 'euler'.*'ddpm' or 'ddim'"),
        ({"context_chunks": 1}, "context_chunks = 1"),
        ({"sound": "mfcc"}, "sound = 'mfcc'.*'mel' or 'wav2vec2'"),
        ({"diffusion": {"temperatures": {"nose": 1, "horn": 1}}}, "diffusion.temperatures.horn: no channel of arkit58"),
        ({"diffusion": {"temperatures": {"eye": -1}}}, "diffusion.temperatures.eye.0 = -1"),
        ({"diffusion": {"temperature": "hot"}}, "diffusion.temperature = 'hot'"),
        ({"chunks": 6}, "'chunks' is not a known key.*chunk_frames"),
        ({"code_levels": []}, "code_levels"),
        ({"discrete": True, "draws": "step"}, "discrete: true is of draws: motion, not step"),
        ({"kind": "argi"}, "kind = 'argi' is not a kind of listener.*arig"),
    ],
)
def test_what_is_wrong_is_named(changes, said: str):
    with pytest.raises(ConfigError, match=said):
        parse_listener(RAW | changes, "listener.yaml")


@pytest.mark.parametrize(("bits", "most"), [(16, 0.01), (8, 0.05)])
def test_weights_in_fewer_bits_make_a_frame_that_differs_by_little_of_its_spread(bits, most, tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint, "LARGE", 64)  # this one's matrices are small
    exact = arig_listener()
    exact.model.motion_mean.fill_(0.5)  # inside 0..1, where nothing is clipped
    exact.model.motion_std.fill_(0.02)
    checkpoint.save_config(tmp_path, exact.settings)
    checkpoint.save_weights(tmp_path / checkpoint.WEIGHTS, exact.model, bits)
    shorter, memory, frames = load_folder(tmp_path), exact.start(1), []
    for frame in talk(40):
        other, _ = shorter.step(frame, memory)
        plan, memory = exact.step(frame, memory)
        frames.append((plan.frames[0], other.frames[0]))
    before, after = np.array(frames).swapaxes(0, 1)
    distance = np.sqrt(np.square(after - before).mean(0)) / before.std(0)
    assert 0 < distance.mean() < most
