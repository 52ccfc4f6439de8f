"""What each paper says, and that the configuration of its name does it; and that cards name every departure from it."""

import re
from operator import attrgetter
from pathlib import Path
from typing import Any

import pytest
import torch

from sfms_robot import config
from sfms_robot.config import load_training
from sfms_robot.data import data_dir
from sfms_robot.lab.learning.training_loop import optimizer, schedule
from sfms_robot.listeners import checkpoint

TRAINING = data_dir("configs") / "training"
# Of a listener or its training, what is its size, not its method: the same in both files.
SIZES = {
    "description", "batch", "evaluate_every", "heads", "learning_rate", "precision", "seed", "steps", "window_frames",
}  # fmt: skip


def trained(name: str) -> Any:
    return load_training(TRAINING / f"{name}.yaml")


def off(part: str, keys: str) -> dict[str, None]:
    """Return the keys of a part, each switched off."""
    return dict.fromkeys(f"{part}.{key}" for key in keys.split())


def holds(one: Any, wanted: Any) -> bool:
    """Return whether the keys have these values (None stands for 0 and False too), or a rule of the whole holds."""
    if callable(wanted):
        return bool(wanted(one))
    found = {key: attrgetter(key)(one) or None for key in wanted}
    return found == {key: value or None for key, value in wanted.items()}


def groups(one: Any) -> list[Any]:
    return list(one.listener.groups.values())


SFMS = {
    "III-B: 52 expressions and 6 of pose": {"listener.motion_space": "faceverse58"},
    "IV-B2, Algorithm 1, (4) to (7): keyframes by Gumbel top-k scores": {"listener.placement": "learned_paper"},
    "IV-B2: the temperature is annealed": lambda one: one.tokenizer.temperature[0] > one.tokenizer.temperature[1],
    "IV-B3: k is fixed": lambda one: all(each.keyframes and each.keyframe_cost is None for each in groups(one)),
    "IV-B2: one mask C(t) of the whole face": lambda one: len(groups(one)) == 1,
    "IV-B4: finite scalar quantization": {"listener.quantizer": "fsq"},
    "IV-B4: of 256 codes": lambda one: [group.codes for group in groups(one)] == [256],
    "(9), (10): the inpainter alone, no straight lines": {"listener.inpainter": "paper", "listener.ramp_frames": None},
    "(11): told of the speaker's face and voice and the own past": off("listener", "events sway phase"),
    "(13): motion, codes, masks": lambda one: one.tokenizer.mask_loss > 0 == one.tokenizer.velocity_loss,
    "(14): classes weigh differently": lambda one: one.predictor.transition_weight != 1,
    "(14): and that is all": off("predictor", "undo_weight calibration_rounds"),
    "IV-C: sequences that begin neutral": lambda one: one.predictor.neutral_prefix > 0,
    "IV-D3: soft-DTW beside the cross-entropy": lambda one: one.predictor.dtw_weight > 0,
    "IV-D3: the encoded ground truth, as it is": off(
        "predictor", "history_noise missed_keyframes event_windows drop_audio drop_face gain_db group_weights"
    ),
    "V-C: 40 past frames, 8 future ones": {"listener.past_frames": 40, "listener.future_frames": 8},
    "V-C: 8 frames in parallel": off("listener", "sequential"),
    "V-C: the window rolls on by what was predicted": {"listener.hop_frames": 8},
    "V-B, V-C: keyframes of each window by itself": {"predictor.tokens": "windows"},
    "V-B: windows of 48 frames": {"listener.window_frames": 48},
    "nothing is done to the motion afterwards": off("listener.sampling", "smoothing reach"),
    "nor where windows meet": {"listener.sampling.seam_frames": 1},
}


@pytest.mark.parametrize("name", ["sfms-as-written", "sfms-paper"])
@pytest.mark.parametrize("said", SFMS)
def test_the_configuration_does_what_the_sfms_paper_says(said, name):
    assert holds(trained(name), SFMS[said])


ARIG = {
    "(1): told of sounds and motions": off("listener", "events phase"),
    "3.2: both modalities": {"listener.visual": True},
    "3.2: bidirectional learning": {"listener.interaction": "bidirectional", "listener.bidirectional_layers": 2},
    "3.3: states guide": {"listener.state_guidance": True},
    "3.3: the cross-entropy weighs as much as (3)": {"training.state_weight": 1},
    "3.3: s_(T-1) as it is": off("training", "state_noise"),
    "3.4: M_T ~ p(M_T | z), in a continuous space": {"listener.draws": "motion", "listener.discrete": False},
    "(3) alone teaches motion": {"training.coarse_weight": 0, "training.group_weights": None},
    "(1): the past as it was": off("training", "history_noise speaking_noise"),
    "4.1: sounds and faces as they were": off(
        "training", "drop_audio drop_face drop_agent gain_db colour_db grain_db event_windows quiet_room silent_user"
    ),
    "(4): ancestral sampling": {"listener.diffusion.sampler": "ddpm", "listener.diffusion.temperature": (1.0, 1.0)},
    "(4): nothing scaled or clamped": off("listener.diffusion", "temperatures clamp"),
    "4.1: c = 6, h = 6": {"listener.chunk_frames": 6, "listener.context_layers": 6},
    "4.1: 15 steps": {"listener.diffusion.steps": 15},
    "A.1: 3 frames of sound, 5 of motion": {"listener.sound_frames": 3, "listener.motion_frames": 5},
    "A.1: 3 blocks": {"listener.diffusion.blocks": 3},
    "4.1: talking, listening, interaction, in this order": lambda one: (
        [stage.interaction > 0 for stage in one.training.stages] == [False, False, True]
        and one.training.stages[0].listening == 0 < one.training.stages[1].listening
    ),
}


@pytest.mark.parametrize("name", ["arig-as-written", "arig-paper"])
@pytest.mark.parametrize("said", ARIG)
def test_the_configuration_does_what_the_arig_paper_says(said, name):
    assert holds(trained(name), ARIG[said])


WIDTHS = {
    "sfms": {"tokenizer_width": 256, "predictor_width": 256},  # V-B
    "arig": {"width": 512, "feedforward": 2048, "context_chunks": 512},  # A.2, 4.1
}
DEPTHS = {"layers", "tokenizer_layers", "predictor_layers", "speaker_layers"}  # V-A gives parameters and hours alone
RUN_LENGTH = {"warm_up_steps", "checkpoint_every", "score_learning_rate"}


@pytest.mark.parametrize("kind", WIDTHS)
def test_the_paper_at_its_size_is_the_one_as_written_but_for_sizes(kind):
    written, paper = (leaves(trained(f"{kind}-{ending}").model_dump(mode="json")) for ending in ("as-written", "paper"))
    differing = {key for key in written.keys() | paper.keys() if written.get(key) != paper.get(key)}
    assert differing - SIZES - DEPTHS - RUN_LENGTH - {"width"} <= WIDTHS[kind].keys()
    assert {key: getattr(trained(f"{kind}-paper").listener, key) for key in WIDTHS[kind]} == WIDTHS[kind]
    assert kind == "sfms" or trained("arig-paper").listener.diffusion.width == 262  # A.2


def test_both_papers_optimizer_is_theirs():
    """V-A: AdamW, betas 0.9 and 0.98, cosine annealing."""
    found = optimizer([torch.nn.Parameter(torch.zeros(1))], 1e-3, 0.01)
    assert isinstance(found, torch.optim.AdamW) and found.defaults["betas"] == (0.9, 0.98)
    phase = trained("sfms-as-written").predictor
    assert schedule(phase.steps, phase) == pytest.approx(0, abs=1e-6)
    assert schedule(phase.steps // 2, phase) == pytest.approx(0.5, abs=0.03)


PAIRS = {"sfms-small": ("sfms-small", "sfms-as-written"), "arig-small": ("arig", "arig-as-written")}


def leaves(tree: dict[str, Any]) -> dict[str, Any]:
    """By name, without the sections that they are in: no two of those compared share one."""
    found: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, dict) and key not in ("groups", "temperatures", "group_weights"):
            found |= leaves(value)
        else:
            found[key] = value
    return found


def settings_of(name: str) -> dict[str, Any]:
    """The listener and its training; groups by how many they are, since what they cost is said of `placement`."""
    raw = trained(name).model_dump(mode="json")
    return {f"{part}.{key}": value for part, section in raw.items() if isinstance(section, dict)
            for key, value in leaves(section).items()}  # fmt: skip


def departures(listener: str) -> set[str]:
    """Keys that the shipped listener, or how it is trained, has otherwise than its paper."""
    ours, paper = (settings_of(name) for name in PAIRS[listener])
    differing = {key.split(".", 1)[1] for key in ours.keys() | paper.keys() if ours.get(key) != paper.get(key)}
    shipped = leaves(checkpoint.load_config(data_dir("configs") / "listeners" / listener).model_dump(mode="json"))
    written = leaves(trained(PAIRS[listener][1]).listener.model_dump(mode="json"))
    return (differing | {key for key in written if shipped.get(key) != written[key]}) - SIZES


def named(card: Path) -> set[str]:
    """Keys that a card names where it says how the listener leaves its paper."""
    said = card.read_text().split("Where it leaves the paper", 1)[1].split("\n## ", 1)[0]
    return set(re.findall(r"`(?:[a-z]+\.)?([a-z_]+)(?::[^`]*)?`", said))


@pytest.mark.parametrize("listener", PAIRS)
def test_a_card_names_every_departure_from_its_paper_with_the_same_size_steps_and_budget(listener):
    card = data_dir("configs") / "listeners" / listener / "CARD.md"
    assert departures(listener) - named(card) == set(), f"{card.parent.name}: not named in its card"
    ours, paper = (trained(name) for name in PAIRS[listener])
    for part in ("training",) if listener == "arig-small" else ("tokenizer", "predictor"):
        for key in ("steps", "batch", "learning_rate", "precision", "evaluate_every"):
            assert getattr(getattr(ours, part), key) == getattr(getattr(paper, part), key), key
    for key in ("width", "feedforward", "tokenizer_width", "predictor_width", "heads"):
        assert getattr(ours.listener, key, None) == getattr(paper.listener, key, None), key
    assert isinstance(paper, config.ArigTraining) == (listener == "arig-small")
