"""A 16-wide model with seeded weights against outputs kept in tests/assets."""

from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_sfms import plans_of, speech, tiny_listener

from sfms_robot.listeners.sfms.draw import UNDECIDED, Context

GOLDEN = Path(__file__).parents[2] / "assets" / "sfms_tiny.npz"


@torch.no_grad()
def outputs() -> dict[str, np.ndarray]:
    model = tiny_listener().model
    drawn = torch.Generator().manual_seed(5)
    tokens = torch.randint(0, 7, (1, 48, 2), generator=drawn)
    seen = Context(
        face=torch.randn(1, 40, 58, generator=drawn),
        face_known=torch.rand(1, 40, generator=drawn) > 0.3,
        voice=model.predictor.speaker.listen(torch.randn(1, 164, 128, generator=drawn)),
        heard=torch.rand(1, 40, generator=drawn) > 0.3,
        phase=torch.rand(1, 40, 21, generator=drawn),
        tokens=torch.cat([tokens[:, :43], torch.full((1, 5, 2), UNDECIDED)], dim=1),
        control=torch.zeros(1, 48, 0),
    )
    logits = model.predictor.teacher_forced(seen, tokens[:, 40:])
    return {"logits": logits.numpy(), "motion": model.tokenizer.decode(tokens).numpy()}


@pytest.mark.parametrize("name", ["motion", "logits"])
def test_outputs_are_those_on_file(name: str):
    np.testing.assert_allclose(outputs()[name], np.load(GOLDEN)[name], rtol=1e-3, atol=1e-4)


def plan(listener) -> np.ndarray:
    return plans_of(listener, speech(9), seed=1)[8].frames


def test_the_streamed_plan_is_the_one_on_file():
    np.testing.assert_allclose(plan(tiny_listener()), np.load(GOLDEN)["plan"], atol=1e-3)


if __name__ == "__main__":  # writes the file anew, for a change of the architecture that is meant
    np.savez_compressed(GOLDEN, plan=plan(tiny_listener()), **outputs())
