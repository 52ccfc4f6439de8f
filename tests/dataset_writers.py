"""Tiny data sets in the formats that other projects write, with motion that has their statistics."""

import csv
import json
import pickle
from pathlib import Path

import numpy as np
import soundfile
import torch

RNG = np.random.default_rng(0)


def deca(frames: int, pose_first: bool = False) -> np.ndarray:
    """(frames, 56): lively expressions, a head that turns a little, a jaw that opens and hardly does anything else."""
    expression = RNG.normal(0, np.linspace(0.9, 0.15, 50), (frames, 50))
    head = RNG.normal(0, 0.12, (frames, 3))
    jaw = np.abs(RNG.normal(0, [0.08, 0.005, 0.004], (frames, 3)))
    parts = [head, jaw, expression] if pose_first else [expression, head, jaw]
    return np.concatenate(parts, axis=1).astype(np.float32)


def faceverse(frames: int, pose_first: bool = False) -> np.ndarray:
    """(frames, 58): expressions 0..1, a head about (pi, 0, 0), about 1.8 away."""
    expression = RNG.uniform(0, 0.6, (frames, 52))
    rotation = RNG.normal([np.pi, 0, 0], 0.1, (frames, 3))
    place = RNG.normal([0, 0, 1.84], 0.05, (frames, 3))
    parts = [rotation, place, expression] if pose_first else [expression, rotation, place]
    return np.concatenate(parts, axis=1).astype(np.float32)


def wav(file: Path, seconds: float, rate_hz: int = 16_000, channels: int = 1) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    soundfile.write(file, RNG.normal(0, 0.1, (round(seconds * rate_hz), channels)), rate_hz)


def npy(file: Path, values: np.ndarray) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    np.save(file, values)


def l2l(root: Path, subject: str = "conan", train: int = 10, test: int = 2, pose_first: bool = False) -> Path:
    """Both directions of one subject; the second has one clip more."""
    for split, count in (("train", train), ("test", test)):
        for person in (0, 1):
            for role in ("list", "speak"):
                clips = count + (person if role == "list" else 1 - person)
                faces = np.stack([deca(64, pose_first) for _ in range(clips)])
                detail = np.zeros((clips, 64, 128), np.float32)
                stem = root / subject / split / f"p{person}_{role}"
                npy(Path(f"{stem}_faces_clean_deca.npy"), np.concatenate([faces, detail], axis=2))
                if role == "speak":
                    power = RNG.exponential(1.0, (clips, 256, 128)).astype(np.float32)
                    npy(Path(f"{stem}_audio_clean_deca.npy"), power)
                    npy(Path(f"{stem}_files_clean_deca.npy"), np.full((clips, 64, 3), "video", dtype="<U64"))
    return root


def lm_listener(root: Path, subject: str = "trevor", lengths: tuple[int, ...] = (70, 90), **more) -> Path:
    folder = root / subject
    folder.mkdir(parents=True, exist_ok=True)
    for split in ("train", "val", "test"):
        segments = []
        for number, frames in enumerate(lengths):
            segment = {"fname": f"video{number}", "split_start_frame": 0, "split_end_frame": frames,
                       "during_words": [{"text": "so", "end": 1.5}]}  # fmt: skip
            for person in ("p0", "p1"):
                motion = torch.from_numpy(deca(frames))
                segment |= {f"{person}_exp": motion[:, :50], f"{person}_pose": motion[:, 50:],
                            f"{person}_shape": torch.zeros(frames, 100)}  # fmt: skip
            segments.append(segment | more)
        torch.save(segments, folder / f"segments_{split}.pth")
    return root


def react(root: Path, pairs: int = 2, split: str = "val", frames: int = 101, pose_first: bool = False) -> Path:
    """An expert and a novice each (published: 751 frames); the Emotion tree with the names of the cleaned release."""
    rows = []
    for number in range(pairs):
        people = [f"NoXI/00{number}_Paris/{person}/1" for person in ("Expert_video", "Novice_video")]
        rows.append(people)
        for person, plain in zip(people, ("P1", "P2"), strict=True):
            npy(root / split / "3D_FV_files" / f"{person}.npy", faceverse(frames, pose_first)[:, None])
            wav(root / split / "Audio_files" / f"{person}.wav", frames / 25, 44_100, 2)
            emotion = root / split / "Emotion" / f"NoXI/00{number}_Paris/{plain}/1.csv"
            emotion.parent.mkdir(parents=True, exist_ok=True)
            header = ",".join(f"AU{i}" for i in range(25))
            np.savetxt(emotion, RNG.uniform(0, 1, (frames, 25)), delimiter=",", header=header, comments="")
    with (root / f"{split}.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["", "speaker_path", "listener_path"])
        writer.writerows([index, *row] for index, row in enumerate(rows))
    return root


def react2025(root: Path, lengths: tuple[int, ...] = (60, 75), split: str = "train") -> Path:
    for number, frames in enumerate(lengths):
        path = f"session{number}/take_{number}"
        for role in ("speaker", "listener"):
            folder = root / "data" / split
            npy(folder / "coefficients" / role / f"{path}.npy", faceverse(frames)[:, None])
            npy(folder / "facial-attributes" / role / f"{path}.npy", RNG.uniform(0, 1, (frames, 25)))
            npy(folder / "audio-features" / role / f"{path}.npy", RNG.normal(0, 1, (frames - 1, 768)))
            wav(folder / "audio" / role / f"{path}.wav", frames / 30)
    return root


def dualtalk(root: Path, chats: int = 2, frames: int = 100, split: str = "train") -> Path:
    for number in range(chats):
        for person in (1, 2):
            stem = root / split / f"{number:04d}_speaker{person}"
            wav(stem.with_suffix(".wav"), frames / 25)
            motion = deca(frames)
            np.savez(stem.with_suffix(".npz"), exp=motion[:, :50], pose=motion[:, 50:])
    return root


def dim(root: Path, lengths: tuple[int, ...] = (80, 90, 100), pose_first: bool = True) -> Path:
    folder = root / "vico_processed_30fps"
    folder.mkdir(parents=True, exist_ok=True)
    splits = ["train", "train", "test"]
    with (root / "RLD_data.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["attitude", "audio", "listener", "speaker", "speaker_id", "listener_id", "data_split"])
        for number, (frames, split) in enumerate(zip(lengths, splits, strict=True)):
            writer.writerow(["positive", f"id{number}", f"l{number}", f"s{number}", 1, 2, split])
            arrays = {"audio": RNG.normal(0, 1, (frames, 768)), "video_speaker": deca(frames, pose_first),
                      "video_listener": deca(frames, pose_first)}  # fmt: skip
            (folder / f"id{number}.pkl").write_bytes(pickle.dumps(arrays))
    return root


def vico(root: Path, lengths: tuple[int, ...] = (60, 70)) -> Path:
    (root / "metadata").mkdir(parents=True)
    lines = ["uuid,attitude"]
    for number, frames in enumerate(lengths):
        lines.append(f"u{number},neutral")
        npy(root / "features" / "audio_feats" / f"u{number}.npy", RNG.normal(0, 1, (frames, 45)))
        for role in ("speaker", "listener"):
            file = root / "features" / "video_feats" / f"u{number}.{role}.bin"
            file.parent.mkdir(parents=True, exist_ok=True)
            motion = RNG.normal(0, 1, (frames, 73)).astype(np.float32)
            torch.save({"id.gamma.tex": np.zeros((frames, 187), np.float32), "angle.exp.trans": motion}, file)
    (root / "metadata" / "data.csv").write_text("\n".join(lines) + "\n")
    return root


def dualtalk_demo(root: Path, frames: int = 100) -> Path:
    """Two voices in samples of 32-bit floats, one face, of whom the model is to answer, as in the published demo."""
    for number, faced in enumerate((2, 1)):
        for person in (1, 2):
            stem = root / "demo" / f"abc_sub_video_{number}_000_speaker{person}"
            stem.parent.mkdir(parents=True, exist_ok=True)
            voice = RNG.normal(0, 0.1, frames * 640 - 768)  # they end a little before the face
            soundfile.write(stem.with_suffix(".wav"), voice, 16_000, subtype="FLOAT")
            if person == faced:
                motion = deca(frames)
                more = {"shape": (100,), "tex": (50,), "cam": (3,), "light": (9, 3)}
                zeros = {key: np.zeros((frames, *shape), np.float32) for key, shape in more.items()}
                np.savez(stem.with_suffix(".npz"), exp=motion[:, :50], pose=motion[:, 50:], **zeros)
    return root


def dualtalk_arkit(root: Path, chats: int = 2, frames: int = 100, split: str = "train") -> Path:
    """The edition in ARKit's shapes beside the one in FLAME's."""
    dualtalk(root, chats, frames, split)
    for number in range(chats):
        for person in (1, 2):
            weights = RNG.uniform(0, 0.6, (frames, 51))
            head = RNG.normal(0, 0.2, (frames, 3)).clip(-1, 1)  # yaw, pitch, roll
            rows = np.concatenate([weights, np.zeros((frames, 1)), head, np.zeros((frames, 6))], axis=1)
            npy(root / "ARKit_npy" / split / f"{number:04d}_speaker{person}.npy", rows.astype(np.float32))
    return root


SEAMLESS_ID = "V00_S0809_I00000582"


def seamless_speech(seconds: float, first: bool) -> list[tuple[float, float]]:
    """Turns of 1.5 s with pauses of 0.5 s, the two people by turns."""
    starts = np.arange(0.3 if first else 2.3, seconds - 1.6, 4.0)
    return [(round(float(start), 3), round(float(start) + 1.5, 3)) for start in starts]


def seamless_person(
    folder: Path, name: str, frames: int = 240, first: bool = True, invalid=(), late_s: float = 0.0, **arrays
) -> None:
    """One person's three files, his voice `late_s` behind its annotation; `arrays` replace those of the .npz."""
    folder.mkdir(parents=True, exist_ok=True)
    seconds = frames / 30
    spans = seamless_speech(seconds, first)
    voice = RNG.normal(0, 1e-4, round(seconds * 48_000))
    for start, end in spans:
        at, to = (max(0, round((edge + late_s) * 48_000)) for edge in (start, end))
        voice[at:to] += 0.1 * np.sin(2 * np.pi * 150 * np.arange(len(voice[at:to])) / 48_000)
    soundfile.write(folder / f"{name}.wav", voice, 48_000, subtype="PCM_16")
    words = [{"words": [], "start": start, "end": end, "transcript": "Yeah."} for start, end in spans]
    vad = [{"start": start, "end": end} for start, end in spans]
    told = {"id": name, "metadata:transcript": words, "metadata:vad": vad}
    (folder / f"{name}.json").write_text(json.dumps(told))
    times_s, valid = np.arange(frames) / 30, np.ones((frames, 1), np.float32)
    for start, end in invalid:
        valid[start:end] = 0
    rotation = 0.15 * np.sin(times_s[:, None] * (3.0, 1.1, 0.7) + float(first))
    units = 1.0 + 0.9 * np.sin(times_s[:, None] * np.linspace(0.5, 4, 24) + float(first))
    rows = {
        "movement:alignment_head_rotation": (rotation * valid).astype(np.float32),
        "movement:FAUValue": (units * valid).astype(np.float32),
        "movement:is_valid": valid,
        "movement:expression": np.zeros((frames, 128), np.float32),
        "smplh:body_pose": np.zeros((frames, 21, 3), np.float32),
    } | arrays
    np.savez_compressed(folder / f"{name}.npz", **{key: value for key, value in rows.items() if value is not None})


def seamless(root: Path, interactions: int = 2, frames: int = 240, split: str = "train", **more) -> Path:
    """Two people an interaction, in different archives of a batch, as the data set keeps partners."""
    for number in range(interactions):
        for first, archive in ((True, "0005"), (False, "0011")):
            name = f"V00_S{809 + number:04d}_I00000582_P{947 + (not first):04d}{'A' * (not first)}"
            seamless_person(root / "improvised" / split / "0000" / archive, name, frames, first, **more)
    return root


def seen(rotation: np.ndarray, jaw: np.ndarray, eyes: np.ndarray, mirrored: bool = False) -> np.ndarray:
    """(T, 133, 3) key points of a face in a picture (x right, y down) that turns, talks and blinks in FLAME's terms."""
    pitch, yaw, roll = (rotation * ((1, -1, -1) if mirrored else (1, 1, 1))).T
    points = np.zeros((len(rotation), 133, 3), np.float32)
    points[..., 2] = 0.9
    points[:, 1, 0], points[:, 2, 0] = 530, 470  # the left eye at the picture's right
    points[:, 2, 1], points[:, 1, 1] = 400 + 60 * roll, 400
    points[:, 0, 0], points[:, 0, 1] = 500 + 40 * yaw, 430 + 40 * pitch + 30 * roll
    points[:, 23 + 66, 1] = 10 * jaw
    for above, below in ((37, 41), (38, 40), (43, 47), (44, 46)):
        points[:, 23 + above, 1], points[:, 23 + below, 1] = 398, 406 - 3 * eyes
    return points
