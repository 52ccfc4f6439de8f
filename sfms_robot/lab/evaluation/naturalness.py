"""`evaluate naturalness`: a listener's motion compared with that of people on whose motion it was never trained.

Besides statistics of movement and drift, a small network tries to distinguish the two: a classifier two-sample test
(Lopez-Paz and Oquab 2017). Both motions are cut into windows of two seconds, by region of the face, after the same 6 Hz
low-pass and with the noise of a face tracker, so that motion is judged, not rounding or a missing tremor. A network of
three convolutions learns on the windows of most dyads and scores those of the others, in folds by dyad. Each dyad is
only on one side, while a person or a voice may be on both, since a split has few of them. The area under its ROC curve
is 0.5 for indistinguishable motions, 1 for always distinguishable ones.

Network, windows, noise and seeds are fixed, so that figures are comparable between versions. Nothing here may ever
become a training loss.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import chain, cycle, islice, product
from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.signal import butter, sosfiltfilt
from torch import Tensor, nn

from sfms_robot.app.progress import tracked
from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNELS, FRAME_HZ, FRAME_S, POSE_CHANNELS, Bools, Doubles, Floats, changed
from sfms_robot.lab import Figures
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.corpora.collection import speaks
from sfms_robot.lab.corpora.formats import detect, split_names
from sfms_robot.lab.corpora.phrase_timing import rank_auc
from sfms_robot.lab.evaluation.detection import middle, movement, nods_of, slow_poses_deg
from sfms_robot.lab.evaluation.intervals import Chosen, bootstrap, intervals, people_of, rounded
from sfms_robot.lab.evaluation.rollout import frames_of_dyad, load_at_hop, rollout, rollouts, spread, streamable
from sfms_robot.listeners.engine import EngineName
from sfms_robot.listeners.registry import engine_name, one_thread

REGIONS: Final = {  # channels by the beginnings of their names
    region: [index for index, name in enumerate(CHANNELS) if name.startswith(names)]
    for region, names in {
        "head": POSE_CHANNELS,
        "eyes": ("eyeLook",),
        "lids": ("eyeBlink", "eyeSquint", "eyeWide"),
        "mouth": ("jaw", "mouth", "cheek", "nose", "tongue"),
        "brows": ("brow",),
    }.items()
}
ByDyad = Sequence[Floats]  # motion of each dyad, or windows of it
FOLDS: Final = 5
WINDOW: Final = 2 * FRAME_HZ
_LOW_PASS_HZ: Final = 6.0
_NOISE: Final = np.array([np.deg2rad(0.15)] * 3 + [0.0005] * 3 + [0.02] * 52)  # rad, m, fraction of full closure
_STEPS: Final = 240
_BATCH: Final = 64
_WIDTH: Final = 24
_LEARNING_RATE: Final = 3e-3
_WEIGHT_DECAY: Final = 0.02
_RESAMPLED: Final = 400  # draws of dyads, for an interval
_SEED: Final = 20
_CHUNK: Final = 512


def evaluate_naturalness(
    name: str, data: Path, split: str, clips: int | None, drift_s: float, seed: int, engine: EngineName = "auto"
) -> Figures:
    """Roll a listener out over the dyads of `split`, and compare its motion with that of their listeners.

    Raises ConfigError for fewer than ten dyads, and for people of training. Blocks for minutes and shows its progress.
    """
    one_thread()
    if split == "train":
        raise ConfigError("--split train: listeners were trained on these people; validation and test are others")
    dyads = spread([*streamable(data, split)], clips)
    if len(dyads) < 2 * FOLDS:
        raise ConfigError(f"{data}: {len(dyads)} dyads of {split}; this comparison needs {2 * FOLDS} or more")
    listener = load_at_hop(name, engine=engine)
    ours = [motion for motion, _ in rollouts(listener, dyads, seed, f"{name} listens")]
    # The input of one stream is one person after another.
    frames = islice(cycle(chain.from_iterable(map(frames_of_dyad, dyads))), round(drift_s * FRAME_HZ))
    timed = [changed(frame, time_s=number * FRAME_S) for number, frame in enumerate(frames, start=1)]
    long = rollout(listener, timed, [seed], title="a long run").motion[0]
    theirs, training = [dyad.listener for dyad in dyads], list[Floats]()
    if "train" in split_names(*detect(data, "auto")):
        some = [*streamable(data, "train", most=len(dyads))]
        if len(some) == len(dyads):  # the training split must have as many dyads
            training = listening(some, [dyad.listener for dyad in some])
    tests = two_samples(listening(dyads, ours), listening(dyads, theirs), training)
    addressed = [
        np.ones(len(dyad.listener), bool) if dyad.attention is None else np.asarray(dyad.attention > 0.5)
        for dyad in dyads
    ]
    drawn, recorded = ([nods_of([motion]) for motion in motions] for motions in (ours, theirs))
    ratios = partial(nod_ratios, drawn, recorded)
    tests["interval"] |= intervals(bootstrap(ratios, people_of(dyads, [1] * len(dyads), 1)))
    return {
        "listener": name,
        "engine": engine_name(listener),
        "split": split,
        "dyads": len(dyads),
        "minutes": round(sum(map(len, ours)) * FRAME_S / 60, 1),
        **tests,
        **compared(ratios(np.arange(len(dyads))) | movement(ours, addressed), movement(theirs, addressed)),
        **drifted(long, theirs),
        "notes": notes(dyads, training),
    }


def notes(dyads: Sequence[Dyad], training: ByDyad) -> list[str]:
    """Return notes for a reader of the figures."""
    unknown = sum(dyad.attention is None for dyad in dyads)
    found = [f"the person's attention is unknown in {unknown} dyads: gaze counts all the time there"] if unknown else []
    return found if training else [*found, "too few dyads of training to compare its people with these"]


def listening(dyads: Sequence[Dyad], motions: ByDyad) -> list[Floats]:
    """Return the windows (W, 50, 58) of each motion (N, 58) in which the dyad's listener is silent.

    A talking mouth is compared with its speech elsewhere (`evaluate interaction`).
    """
    rng, found = np.random.default_rng(0), []
    for motion, dyad in zip(motions, dyads, strict=True):
        frames, said = len(dyad.listener), dyad.agent_audio
        silent = np.ones(frames, bool) if said is None else ~speaks(said, frames, FRAME_HZ)
        found.append(windows(motion, rng, silent[: len(motion)]))
    return found


def compared(ours: Mapping[str, float], theirs: Mapping[str, float]) -> Figures:
    """Return the figures of `movement` of both; None where there is no data."""
    figures = {**ours, **{f"people_{name}": value for name, value in theirs.items()}}
    return {name: rounded(value, 3) for name, value in figures.items()}


def nod_ratios(ours: Sequence[Doubles], theirs: Sequence[Doubles], chosen: Chosen) -> dict[str, float]:
    """Return the medians of our nods (rows of `nods_of`) in the motions `chosen`, over the medians of theirs."""
    drawn, recorded = (np.concatenate([nods[place] for place in chosen]).T for nods in (ours, theirs))
    figures = zip(("amplitude", "length", "cycle"), drawn, recorded, strict=False)
    return {f"nod_{name}_ratio": middle(a) / middle(b) for name, a, b in figures}


def drifted(motion: Floats, theirs: ByDyad) -> Figures:
    """Return the head's distance from the middle, and from people's 1 to 99 %, at the end of a long run."""
    end = np.median(slow_poses_deg([motion])[-6:], axis=0)
    low, high = np.percentile(slow_poses_deg(theirs), [1, 99], axis=0)
    outside = np.maximum(np.maximum(low - end, end - high), 0.0)
    return {
        "drift_deg": round(float(np.abs(end).max()), 2),
        "drift_outside_people_deg": round(float(outside.max()), 2),
        "people_pose_deg": dict(zip(("roll", "pitch", "yaw"), np.round([low, high], 2).T.tolist(), strict=True)),
    }


# --- two-sample tests -----------------------------------------------------------------------------------------------


def two_samples(ours: ByDyad, theirs: ByDyad, training: ByDyad) -> Figures:
    """Return by region `two_sample_auc` of windows by dyad, each with its interval over dyads, and tests for scale.

    For scale: people against other people of the same split and, if `training` is given, people of training against
    people of this split, since a perfect imitation of training could be distinguished as often.
    `imitated_two_sample_auc`: ours against people of training. `levelled_`: each motion standardised by its own mean
    and deviation.
    """
    half = 2 * (len(theirs) // 2)
    pairs: dict[str, tuple[ByDyad, ByDyad]] = {
        "two_sample_auc": (ours, theirs),
        "person_two_sample_auc": (theirs[:half:2], theirs[1:half:2]),
    }
    if training:
        pairs |= {"training_two_sample_auc": (training, theirs), "imitated_two_sample_auc": (ours, training)}
    pairs |= {
        f"levelled_{name}": ([*map(levelled, one)], [*map(levelled, other)]) for name, (one, other) in pairs.items()
    }
    found, interval = ({name: Figures() for name in pairs} for _ in range(2))
    for name, region in tracked(list(product(pairs, REGIONS)), "two-sample tests"):
        auc, *ends = separability(*pairs[name], region)
        found[name][region], interval[name][region] = round(auc, 3), [round(end, 3) for end in ends]
    return {**found, "interval": interval}


def windows(motion: Floats, rng: np.random.Generator, judged: Bools | None = None) -> Floats:
    """Return consecutive windows (W, 50, 58) of motion (N, 58), low-passed, with a tracker's noise.

    With `judged` (N,), only windows in which all frames are judged. A motion shorter than a window has none.
    """
    if len(motion) < WINDOW:
        return np.zeros((0, WINDOW, motion.shape[1]), np.float32)
    sections = butter(4, _LOW_PASS_HZ, fs=FRAME_HZ, output="sos")
    smooth = sosfiltfilt(sections, motion.astype(np.float64), axis=0)
    seen = smooth + _NOISE * rng.standard_normal(smooth.shape)
    whole = len(seen) // WINDOW
    cut = np.asarray(seen[: whole * WINDOW].reshape(whole, WINDOW, -1), np.float32)
    return cut if judged is None else cut[judged[: whole * WINDOW].reshape(whole, WINDOW).all(axis=1)]


def levelled(part: Floats) -> Floats:
    """Return windows (W, 50, 58) of one motion with each channel standardised over all of them.

    Rest poses and amplitudes differ from take to take; the shape of the motion remains.
    """
    if not len(part):
        return part
    return np.asarray((part - part.mean(axis=(0, 1))) / part.std(axis=(0, 1)).clip(min=1e-6), np.float32)


def separability(ours: ByDyad, theirs: ByDyad, region: str) -> tuple[float, float, float]:
    """Return the area under the ROC curve and its 95 % interval over dyads, of windows (W, 50, 58) by dyad.

    Entry d of both is the same dyad, or at least shares no person with another entry. Raises ValueError for fewer dyads
    than folds.
    """
    if len(ours) != len(theirs) or len(ours) < FOLDS:
        raise ValueError(f"dyads: expected equally many, {FOLDS} or more, got {len(ours)} and {len(theirs)}")
    clips = [part[..., REGIONS[region]] for part in (*ours, *theirs)]
    sizes = [len(part) for part in clips]
    dyad = np.repeat(np.tile(np.arange(len(ours)), 2), sizes)
    label = np.repeat(np.repeat([1, 0], len(ours)), sizes)
    values = torch.from_numpy(np.concatenate(clips))
    fold = np.random.default_rng(_SEED).permutation(len(ours)) % FOLDS
    scores = np.zeros(len(values))
    for number in range(FOLDS):
        held_out = fold[dyad] == number
        if held_out.any() and not held_out.all():
            scores[held_out] = _scores(values[~held_out], label[~held_out], values[held_out], _SEED + number)

    def auc(chosen: Chosen) -> dict[str, float]:
        return {"auc": rank_auc(scores[chosen], label[chosen] == 1, label[chosen] == 0)}

    low, high = intervals(bootstrap(auc, dyad.astype(str).tolist(), seed=_SEED, draws=_RESAMPLED))["auc"]
    return auc(np.arange(len(dyad)))["auc"], low, high


def _scores(values: Tensor, label: NDArray[np.intp], unseen: Tensor, seed: int) -> Doubles:
    """Train a network on values (N, 50, C) with labels (N,) 1 or 0; return log-odds (M,) of `unseen` (M, 50, C)."""
    mean, deviation = values.mean((0, 1)), values.std((0, 1)).clamp(min=1e-6)
    values, unseen = (((each - mean) / deviation).transpose(1, 2) for each in (values, unseen))  # channels first
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = _network(values.shape[1])
        wanted = torch.from_numpy(label).float()
        # Both kinds weigh the same, regardless of their numbers of windows.
        loss = nn.BCEWithLogitsLoss(pos_weight=(1 - wanted).sum() / wanted.sum().clamp(min=1))
        optimizer = torch.optim.AdamW(network.parameters(), _LEARNING_RATE, weight_decay=_WEIGHT_DECAY)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, _LEARNING_RATE, _STEPS)
        for _ in range(_STEPS):
            rows = torch.randint(len(values), (_BATCH,))
            optimizer.zero_grad()
            loss(network(values[rows])[:, 0], wanted[rows]).backward()
            optimizer.step()
            schedule.step()
        network.eval()
        with torch.no_grad():
            parts = [network(part)[:, 0] for part in torch.split(unseen, _CHUNK)]
    return np.asarray(torch.cat(parts).double().numpy(), np.float64)


def _network(channels: int) -> nn.Sequential:
    """Build three convolutions over time, the mean and maximum of their output, and one number."""
    layers: list[nn.Module] = [nn.Conv1d(channels, _WIDTH, 5, padding=2), nn.GELU()]
    for _ in range(2):
        layers += [nn.Conv1d(_WIDTH, _WIDTH, 5, stride=2, padding=2), nn.GELU()]
    return nn.Sequential(*layers, _MeanAndMost(), nn.Dropout(0.2), nn.Linear(2 * _WIDTH, 1))


class _MeanAndMost(nn.Module):
    def forward(self, x: Tensor) -> Tensor:
        """Map (B, W, T) to (B, 2W)."""
        return torch.cat([x.mean(-1), x.amax(-1)], dim=-1)
