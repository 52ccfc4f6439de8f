"""Models 16 wide with seeded weights against outputs kept in tests/assets."""

from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_arig import arig_listener, dyad_of, streamed, talk
from tiny_sfms import plans_of, speech, tiny_listener

from sfms_robot.listeners.sfms.draw import UNDECIDED, Context

ASSETS = Path(__file__).parents[1] / "assets"


@torch.no_grad()
def sfms() -> dict[str, np.ndarray]:
    listener, drawn = tiny_listener(), torch.Generator().manual_seed(5)
    model, tokens = listener.model, torch.randint(0, 7, (1, 48, 2), generator=drawn)
    seen = Context(
        face=torch.randn(1, 40, 58, generator=drawn),
        face_known=torch.rand(1, 40, generator=drawn) > 0.3,
        voice=model.predictor.speaker.listen(torch.randn(1, 164, 128, generator=drawn)),
        heard=torch.rand(1, 40, generator=drawn) > 0.3,
        phase=torch.rand(1, 40, 21, generator=drawn),
        tokens=torch.cat([tokens[:, :43], torch.full((1, 5, 2), UNDECIDED)], dim=1),
        control=torch.zeros(1, 48, 0),
    )
    logits, motion = model.predictor.teacher_forced(seen, tokens[:, 40:]), model.tokenizer.decode(tokens)
    plan = plans_of(listener, speech(9), seed=1)[8].frames
    return {"logits": logits.numpy(), "motion": motion.numpy(), "plan": plan}


@torch.no_grad()
def arig() -> dict[str, np.ndarray]:
    listener, speaker = arig_listener(), talk(14)
    made = torch.from_numpy(np.random.default_rng(0).normal(size=(14, 58)).astype(np.float32))
    found = listener.model.condition(dyad_of(listener, speaker, made))
    return {"z": found.z.numpy(), "states": found.states.numpy(), "motion": streamed(listener, speaker)}


KINDS = {"sfms_tiny": sfms, "arig_tiny": arig}


@pytest.mark.parametrize("name", KINDS)
def test_outputs_are_those_on_file(name: str):
    kept = np.load(ASSETS / f"{name}.npz")
    for key, found in KINDS[name]().items():
        np.testing.assert_allclose(found, kept[key], rtol=1e-3, atol=1e-4 if key == "logits" else 1e-3)


if __name__ == "__main__":  # with PYTHONPATH=tests: writes the files anew, where the architecture is meant to change
    for name, outputs in KINDS.items():
        np.savez_compressed(ASSETS / f"{name}.npz", **outputs())
