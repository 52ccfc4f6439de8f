"""Composed dyads: events of the tables turn up in sound and motion, at their time; nothing jumps."""

import csv
from dataclasses import replace

import numpy as np
import pytest
import soundfile
from ami_tables import HEADERS

from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.frames import BLENDSHAPES, CHANNEL_INDEX, EVENT_KINDS, FRAME_HZ, FRAME_S, POSE, SHAPES
from sfms_robot.lab.corpora import clips
from sfms_robot.lab.corpora.clips import SPLITS
from sfms_robot.lab.corpora.compose import ami, composed
from sfms_robot.lab.corpora.compose.render_events import Score, act, mirrored, nod_habit, nod_of
from sfms_robot.lab.corpora.compose.speaking import Dwell, learn_dwell
from sfms_robot.lab.corpora.compose.voices import find_voices, lay, read_voice, split_voices
from sfms_robot.lab.corpora.formats import open_dataset
from sfms_robot.lab.corpora.phrase_timing import phrase_ends, voice_activity
from sfms_robot.signals.events import find_blinks, find_nods, find_smiles
from sfms_robot.signals.gaze_kinematics import EYE_CHANNELS, EYE_PAN_RAD, EYE_TILT_RAD, directions
from sfms_robot.signals.motion_primitives import read_motions

PITCH = CHANNEL_INDEX["pitch"]
CORNERS = [CHANNEL_INDEX["mouthSmileLeft"], CHANNEL_INDEX["mouthSmileRight"]]
MOTIONS = data_dir("sim") / "listeners" / "motions.npz"
MEETINGS = {"train": "ES2008a", "validation": "IS1000a", "test": "ES2003a"}
UNTIL_S = 240.0


def score(seconds, **events):
    return Score(frames=int(seconds * FRAME_HZ), **events)


def busy(seconds=60.0):
    """Something of every kind, each kind apart from the others of it."""
    nods = np.array([(at, at + long) for at, long in ((3, 0.4), (8, 1.2), (17, 0.8), (33, 0.5), (44, 2.0), (52, 0.7))])
    return score(
        seconds,
        nods=nods,
        shakes=np.array([(14.0, 15.0), (29.0, 29.6)]),
        tilts=np.array([(38.0, 39.0)]),
        laughs=np.array([(24.0, 25.5)]),
        shared_laughs=np.array([(11.0, 12.0), (48.0, 49.0)]),
        backchannels=np.array([(8.2, 8.6)]),
        mm_hms=np.array([(8.2, 8.6)]),
        talk=np.array([(8.2, 8.6), (40.0, 42.0)]),
        gaze=((5.0, 7.0, "down"), (20.0, 22.0, "side A"), (35.0, 36.0, "away"), (56.0, 57.5, "screen")),
        asked=np.array([19.0, 27.0, 46.0]),
        ends=np.array([3.0, 8.0, 17.0]),
    )


@pytest.fixture(scope="module")
def motions():
    return read_motions(MOTIONS)


@pytest.fixture(scope="module")
def katie():
    return read_voice(data_dir("sim") / "speakers" / "katie" / "speech.flac")


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """A series of two people for every part; A talks 3 s of every 4, B nods at each second phrase end and says yes.

    A looks at B for 6 s of every 12, laughs at 61 and nods at 71.
    """
    folder = tmp_path_factory.mktemp("ami")
    rows = {name: [] for name in ("participants", "head_gestures", "gaze_focus", "words", "dialogue_acts")}
    for meeting in MEETINGS.values():
        for agent in "AB":
            rows["participants"].append((meeting, agent, f"{meeting}{agent}", "", UNTIL_S, 1, 1))
        for start in np.arange(1, UNTIL_S - 4, 4):
            rows["words"].append((meeting, "A", start, start + 1.5, "w", "well"))
            rows["words"].append((meeting, "A", start + 1.6, start + 3, "w", "so"))
        for end in np.arange(4, UNTIL_S - 4, 8):
            rows["head_gestures"].append((meeting, "B", end + 0.2, end + 0.9, "concord_signal", "nod"))
            rows["words"].append((meeting, "B", end + 0.3, end + 0.6, "w", "yes"))
            rows["dialogue_acts"].append((meeting, "B", end + 0.3, end + 0.6, "bck"))
            rows["gaze_focus"].append((meeting, "B", end + 2, end + 4, "place", "table"))
        for start in np.arange(0, UNTIL_S, 12):
            rows["gaze_focus"].append((meeting, "A", start, start + 6, "person", "B"))
            rows["gaze_focus"].append((meeting, "A", start + 6, start + 12, "place", "table"))
        rows["head_gestures"].append((meeting, "A", 71.0, 72.0, "concord_signal", "nod"))
        rows["words"].append((meeting, "A", 61.0, 62.0, "vocalsound", "laugh"))
        rows["words"].append((meeting, "B", 101, 101.5, "vocalsound", "laugh"))
    for name, lines in rows.items():
        with (folder / f"{name}.csv").open("w", newline="") as file:
            csv.writer(file).writerows([HEADERS[name].split(","), *lines])
    return folder


def compose(ami_folder, seed, minutes):
    material = composed.material_of(ami_folder)
    return {split: [*composed.dyads(material, "listening", split, seed, minutes)] for split in SPLITS}


@pytest.fixture(scope="module")
def made(tables):
    return compose(tables, seed=3, minutes=3)


def test_one_seed_composes_the_same_dyads_and_another_one_others(tables, made):
    again = compose(tables, seed=3, minutes=3)
    other = compose(tables, seed=4, minutes=3)
    assert [d.name for d in again["train"]] == [d.name for d in made["train"]]
    for one, two in zip(again["train"], made["train"], strict=True):
        np.testing.assert_array_equal(one.listener, two.listener)
        np.testing.assert_array_equal(one.audio, two.audio)
        np.testing.assert_array_equal(one.speaker, two.speaker)
        assert one.events == two.events
    assert not np.array_equal(other["train"][0].listener[:500], made["train"][0].listener[:500])


def test_dyads_are_as_long_as_asked_for_and_meetings_are_kept_apart(made):
    for split, meeting in MEETINGS.items():
        assert {dyad.name.split("_")[0] for dyad in made[split]} == {meeting}
    assert sum(len(dyad.listener) for dyad in made["train"]) / FRAME_HZ / 60 == pytest.approx(3, abs=0.8)
    for dyad in made["train"]:
        assert 30 * FRAME_HZ <= len(dyad.listener) <= 60 * FRAME_HZ


def test_everything_is_used_once_where_enough_is_asked_for_and_more_often_where_one_is_spoken_to(tables):
    rng = np.random.default_rng(0)
    found = composed.stretches(ami.read_people(tables), rng)
    assert sorted(composed.choose(found, 1e6, rng), key=id) == sorted(found, key=id)
    total = sum(one.frames for one in found) * FRAME_S / 60
    some = [sum(one.frames for one in composed.choose(found, total / 3, rng)) * FRAME_S / 60 for _ in range(40)]
    assert np.mean(some) == pytest.approx(total / 3, rel=0.1)
    found = [
        composed.Stretch(person=None, start_s=0.0, end_s=40.0, addressed=share) for share in np.repeat([0.0, 1.0], 100)
    ]
    drawn = composed.choose(found, 40.0, np.random.default_rng(0))
    assert np.mean([one.addressed for one in drawn]) > 0.65


def test_phrases_sound_when_they_were_said(tables, made):
    people = {(person.meeting, person.agent): person for person in ami.read_people(tables)}
    for dyad in made["train"]:
        meeting, agent, start = dyad.name.split("_")
        person = people[meeting, agent]
        if not len(person.others) or agent == "A":
            continue
        heard = phrase_ends(voice_activity(dyad.audio))
        for end in person.others[:, 1] - float(start):
            if 1.5 < end < len(dyad.listener) / FRAME_HZ - 1:  # the name rounds the start down to a second
                assert (np.abs(heard - end) < 1.15).any()


def test_nods_are_where_they_were_annotated(made):
    for dyad in made["train"]:
        if "_B_" not in dyad.name:
            continue
        start = float(dyad.name.split("_")[2])
        expected = [t - start for t in np.arange(4.2, UNTIL_S - 4, 8) if 2 < t - start < len(dyad.listener) / 25 - 2]
        found = find_nods(dyad.listener[:, PITCH] - dyad.head_of_gaze_rad[:, 1], FRAME_HZ)  # a look down is no nod
        assert len(found) >= 0.7 * len(expected)
        for onset, _, _ in found:
            assert np.abs(np.array(expected) - onset).min() < 1.3 or not 2 < onset < len(dyad.listener) / 25 - 2


def test_a_new_set_replaces_the_old_one_and_nothing_else(tables, tmp_path):
    composed.compose_folder(tables, tmp_path, seed=1, minutes=1)
    (tmp_path / "train" / "mine.npz").write_bytes(b"")
    (tmp_path / "train" / "M9z_A_0000.npz").write_bytes(b"")
    before = {file: file.read_bytes() for file in tmp_path.rglob("*.npz")}
    with pytest.raises(ConfigError, match="holds dyads already, .*--overwrite"):
        composed.compose_folder(tables, tmp_path, seed=2, minutes=1)
    assert {file: file.read_bytes() for file in tmp_path.rglob("*.npz")} == before
    composed.compose_folder(tables, tmp_path, seed=1, minutes=1, overwrite=True)
    assert (tmp_path / "train" / "mine.npz").exists() and not (tmp_path / "train" / "M9z_A_0000.npz").exists()


def test_written_sets_read_back(tables, tmp_path):
    told = []
    written = composed.compose_folder(tables, tmp_path, seed=1, minutes=1, moved=lambda *one: told.append(one))
    for split in SPLITS:
        assert sum(len(dyad.listener) for dyad in open_dataset(tmp_path, split)) / FRAME_HZ / 60 == pytest.approx(
            written[split]
        )
    assert {what.split(",")[0] for _, _, what in told} == {"listening", "interaction", "speaking"} - {
        name for name in ("interaction", "speaking") if not written[f"{name}_train"]
    }
    listening = [done for done, _, what in told if what.startswith("listening,")]
    assert listening == sorted(listening)
    assert listening[-1] == pytest.approx(sum(written[split] for split in SPLITS))
    (spoken, *_) = open_dataset(tmp_path / "speaking", "train")
    assert {event.kind for event in spoken.events} >= {"blink"}


def test_the_speaker_looks_at_the_listener_when_it_was_annotated(made):
    toward, aside = [], []
    for dyad in [dyad for split in SPLITS for dyad in made[split]]:
        if "_B_" not in dyad.name or np.isnan(dyad.attention).all():
            continue
        face = dyad.speaker
        gaze = face[:, [2, 1]] + directions(face, np.array([EYE_PAN_RAD, EYE_TILT_RAD])).mean(axis=1)
        for value, found in ((1, toward), (0, aside)):
            rows = dyad.attention == value
            found.append(gaze[rows] - np.nanmedian(gaze[dyad.attention == 1], axis=0))
    near, far = (np.degrees(np.hypot(*np.concatenate(found).T)) for found in (toward, aside))
    assert np.median(near) < 4 and np.median(far) > 12


def test_attention_is_what_was_annotated_and_unknown_where_nobody_is_seen_or_gaze_was_not_annotated(tables, made):
    people = {(person.meeting, person.agent): person for person in ami.read_people(tables)}
    for dyad in made["train"]:
        meeting, agent, _ = dyad.name.split("_")
        assert np.isnan(dyad.attention[np.isnan(dyad.speaker).any(axis=1)]).all()
        if agent == "B":
            stretch = composed.Stretch(person=people[meeting, "B"], start_s=24.0, end_s=48.0)
            told = composed.attention_of(stretch)
            assert (told[1 * 25 : 5 * 25] == 1).all() and (told[7 * 25 : 11 * 25] == 0).all()
    (folder_person, *_) = [person for person in ami.read_people(tables) if person.agent == "B"]
    blind = replace(folder_person, gaze_known=frozenset(), looked_at=())
    assert np.isnan(composed.attention_of(composed.Stretch(person=blind, start_s=20.0, end_s=50.0))).all()


def test_the_speaker_smiles_where_people_laughed_and_nods_where_they_nodded(tables, katie, motions):
    (person, *_) = [person for person in ami.read_people(tables) if person.agent == "B"]
    smiles, nods = 0, 0
    for seed in range(12):
        stretch = composed.Stretch(person=person, start_s=50.0, end_s=80.0)
        _, face = composed.speaker_of(stretch, katie, motions["train"], np.random.default_rng(seed), [], np.empty(0))
        if np.isnan(face).any():
            continue
        laughing, later = slice(12 * FRAME_HZ, 13 * FRAME_HZ), slice(18 * FRAME_HZ, 20 * FRAME_HZ)
        smiles += face[laughing, CORNERS].mean() > face[later, CORNERS].mean() + 0.15
        swings = np.diff(face[:, PITCH])
        nods += np.abs(swings[21 * FRAME_HZ : 22 * FRAME_HZ]).mean() > np.abs(swings).mean()
    assert smiles >= 3 and nods >= 3


def test_a_dwell_is_learned_from_those_who_were_annotated_and_fills_time():
    looks = Dwell((2.0, 4.0), ((1.0, "down"), (0.5, "side A"))).looks(60.0, np.random.default_rng(0))
    assert 8 < len(looks) < 25
    for before, after in zip(looks[:-1], looks[1:], strict=True):
        assert 2 - 1e-9 <= after[0] - before[1] <= 4 + 1e-9
    assert looks[-1][1] <= 60
    assert learn_dwell([]).looks(60.0, np.random.default_rng(0)) == ()


def test_no_voice_take_or_series_is_in_two_parts(motions):
    for named in (clips.SERIES, clips.VOICES):
        every = [name for split in SPLITS for name in named[split]]
        assert len(every) == len(set(every)) and all(named[split] for split in SPLITS)
    with np.load(MOTIONS) as arrays:
        where = {}
        for key in arrays:
            split, _, take, _ = key.split("/")
            assert where.setdefault(take, split) == split
    parts = split_voices(find_voices([data_dir("sim") / "speakers"]))
    assert [voice.name for voice in parts["validation"]] == ["katie"]
    assert [voice.name for voice in parts["test"]] == ["1114_3_16"]


@pytest.mark.parametrize("seed", range(6))
def test_motion_stays_in_range_and_never_jumps(motions, seed):
    motion = act(busy(), motions["train"], np.random.default_rng(seed)).motion
    assert np.isfinite(motion).all() and motion[:, SHAPES].min() >= 0 and motion[:, SHAPES].max() <= 1
    speed = np.abs(np.diff(motion[:, :3], axis=0)) * FRAME_HZ
    bend = np.abs(np.diff(motion[:, :3], n=2, axis=0)) * FRAME_HZ**2
    assert (speed.max(axis=0) < np.deg2rad([120, 150, 180])).all()
    assert np.rad2deg(bend[:, 1].max()) < 2400


@pytest.mark.parametrize("split", SPLITS)
def test_events_are_in_the_motion(motions, split):
    """Detectors that know nothing of the events find nods at their size within 80 ms, blinks and smiles."""
    late, sized = [], []
    for seed in range(6):
        acted = act(busy(), motions[split], np.random.default_rng(seed))
        motion = acted.motion
        of = {kind: [event for event in acted.events if event.kind == kind] for kind in EVENT_KINDS}
        assert [len(of[kind]) for kind in ("nod", "shake", "tilt", "laugh", "mm_hm")] == [6, 2, 1, 1, 1]
        assert len(of["gaze_shift"]) == 8
        assert list(acted.events) == sorted(acted.events, key=lambda event: event.start_s)
        pitch = motion[:, PITCH] - acted.head_of_gaze_rad[:, 1]
        found = find_nods(pitch, FRAME_HZ)
        for nod in of["nod"]:
            start, _, size = min(found, key=lambda one: abs(one[0] - nod.start_s))
            late.append(abs(start - nod.start_s))
            sized.append(size == pytest.approx(nod.size, rel=0.3))
        closed = find_blinks(motion[:, CHANNEL_INDEX["eyeBlinkLeft"]], FRAME_HZ)
        seen = [blink for blink in of["blink"] if blink.size > 0.6 and blink.end_s < 60]
        near = [min(abs(start - blink.start_s) for start, _, _ in closed) < 0.2 for blink in seen]
        assert np.mean(near) > 0.9
        smiling = find_smiles(motion[:, CORNERS].mean(axis=1), FRAME_HZ)
        for smile in (*of["smile"], *of["laugh"]):
            assert any(start < smile.end_s and end > smile.start_s for start, end, _ in smiling)
    assert np.mean(np.array(late) <= 0.081) > 0.85 and np.mean(sized) > 0.85


def test_nothing_but_events_nods_or_smiles_and_one_to_whom_nothing_happens_still_lives(motions):
    for seed in range(6):
        acted = act(score(60, gaze=busy().gaze), motions["train"], np.random.default_rng(seed))
        assert {event.kind for event in acted.events} == {"blink", "gaze_shift"}
        assert find_nods(acted.motion[:, PITCH] - acted.head_of_gaze_rad[:, 1], FRAME_HZ) == []
        assert find_smiles(acted.motion[:, CORNERS].mean(axis=1), FRAME_HZ) == []
    motion = act(score(60), motions["train"], np.random.default_rng(0)).motion
    assert find_nods(motion[:, PITCH], FRAME_HZ) == []
    assert 8 <= len(find_blinks(motion[:, CHANNEL_INDEX["eyeBlinkLeft"]], FRAME_HZ)) <= 32
    for second in range(0, 60, 5):  # the head never freezes
        assert np.ptp(motion[second * 25 : second * 25 + 125, :3], axis=0).max() > np.deg2rad(0.1)


def test_what_is_left_without_the_heads_gaze_does_not_know_where_he_looks(motions):
    looks = [(2.0 + 4 * at, 4.0 + 4 * at, ("side A", "side B", "down")[at % 3]) for at in range(27)]
    known, left, targets = [], [], []
    for seed in range(8):
        acted = act(score(112, gaze=tuple(looks)), motions["train"], np.random.default_rng(seed))
        aimed = np.zeros((len(acted.motion), 2))
        for event in acted.events:
            if event.kind == "gaze_shift":
                rows = slice(round(event.start_s * FRAME_HZ), round((event.start_s + event.duration_s) * FRAME_HZ))
                aimed[rows] = event.target_rad
        targets.append(aimed)
        known.append(acted.motion[:, [2, 1]])
        left.append(acted.motion[:, [2, 1]] - acted.head_of_gaze_rad[:, [2, 1]])
    for axis in (0, 1):
        aimed = np.concatenate(targets)[:, axis]
        assert abs(np.corrcoef(np.concatenate(left)[:, axis], aimed)[0, 1]) < 0.1
        assert np.corrcoef(np.concatenate(known)[:, axis], aimed)[0, 1] > 0.5


def test_nods_are_made_as_a_person_makes_them():
    rng = np.random.default_rng(0)
    made = [nod_of("nod", 0.0, length_s, nod_habit(rng), rng) for length_s in np.repeat([0.3, 0.6, 1.2, 3.0], 300)]
    sizes = np.degrees([one.size for one in made])
    assert sizes.min() >= 2.2 - 1e-6 and sizes.max() <= 12 + 1e-6 and 4 < np.median(sizes) < 6
    assert {one.swings for one in made} == {1, 2, 3, 4}
    for one in made:
        assert 0.3 <= one.duration_s / one.swings <= 0.66


def test_mirroring_twice_is_nothing_and_a_mirrored_listener_looks_the_other_way(motions):
    motion = act(score(5), motions["train"], np.random.default_rng(0)).motion
    np.testing.assert_array_equal(mirrored(mirrored(motion)), motion)
    left, right = (BLENDSHAPES.index(f"mouthSmile{side}") for side in ("Left", "Right"))
    np.testing.assert_array_equal(mirrored(motion)[:, SHAPES][:, left], motion[:, SHAPES][:, right])
    np.testing.assert_array_equal(mirrored(motion)[:, POSE][:, 2], -motion[:, POSE][:, 2])
    sides = set()
    for seed in range(12):
        acted = act(score(10, gaze=((3.0, 6.0, "side B"),)), motions["train"], np.random.default_rng(seed))
        (there, _) = [event for event in acted.events if event.kind == "gaze_shift"]
        sides.add(there.target_rad[0] > 0)
        eyes = directions(acted.motion, np.array([EYE_PAN_RAD, EYE_TILT_RAD])).mean(axis=1)
        gaze = acted.motion[100:140, 2] + eyes[100:140, 0]
        assert np.degrees(np.abs(gaze - there.target_rad[0])).max() < 2
        assert (acted.motion[:, list(EYE_CHANNELS)] >= 0).all()
    assert sides == {True, False}


def test_a_voice_fills_exactly_its_segments_and_a_mouth_moves_only_in_them(katie):
    segments = np.array([[1.0, 2.5], [4.0, 9.0], [9.5, 9.8]])
    audio, mouth = lay(segments, 300, katie, np.random.default_rng(0))
    times, inside = np.arange(len(audio)) / 16_000, np.zeros(len(audio), bool)
    for start, end in segments:
        inside |= (times >= start) & (times < end)
    assert mouth is None
    assert not audio[~inside].any()
    assert phrase_ends(voice_activity(audio))[:2] == pytest.approx([2.5, 9.0], abs=0.13)
    voice = read_voice(data_dir("sim") / "speakers" / "facegood_1114_3_16" / "speech.flac")
    _, mouth = lay(np.array([[2.0, 6.0]]), 250, voice, np.random.default_rng(0))
    assert mouth[:, BLENDSHAPES.index("jawOpen")].max() > 0.1 and not mouth[:48].any() and not mouth[153:].any()


def test_what_cannot_be_composed_is_one_line(tmp_path, tables):
    with pytest.raises(ConfigError, match=r"head_gestures.csv.gz: no such file"):
        ami.read_people(tmp_path)
    for file in tables.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    (tmp_path / "words.csv").write_text("meeting,agent,start_s,end_s,kind\n")
    with pytest.raises(ConfigError, match=r"words.csv: column = 'text' is missing"):
        ami.read_people(tmp_path)
    with pytest.raises(ConfigError, match="no WAV or FLAC file to take voices from"):
        find_voices([tmp_path])
    (tmp_path / "motions.npz").write_bytes(b"nothing")
    with pytest.raises(ConfigError, match="motions.npz: not a file of motion primitives"):
        read_motions(tmp_path / "motions.npz")
    with pytest.raises(ConfigError, match="--minutes -1: must be above 0"):
        compose(tables, seed=1, minutes=-1)


@pytest.mark.slow
def test_several_jobs_write_the_files_of_one(tables, tmp_path):
    told = []
    for jobs in (1, 2):
        found = composed.compose_folder(
            tables, tmp_path / str(jobs), 1, 2.0, lambda done, wanted, what: told.append(what.split(",")[0]), jobs=jobs
        )
    assert found["train"] > 0 and "listening" in told
    one, two = (
        {file.relative_to(tmp_path / jobs): file.read_bytes() for file in (tmp_path / jobs).rglob("*.npz")}
        for jobs in ("1", "2")
    )
    assert one == two and len(one) > 3


@pytest.mark.parametrize("samples", [1, 100, 16_000])
def test_a_recording_without_speech_is_one_line(tmp_path, samples):
    soundfile.write(tmp_path / "voice.wav", np.zeros(samples), 16_000)
    with pytest.raises(ConfigError, match=r"voice\.wav: no speech found in it"):
        read_voice(tmp_path / "voice.wav")
