"""Composed dyads: events of the tables turn up in sound and motion, at their time; nothing jumps."""

import csv

import numpy as np
import pytest

from sfms_robot.corpora.clips import load
from sfms_robot.corpora.compose import ami, composed
from sfms_robot.corpora.compose.acting import Score, listener_motion, mirrored, stretched, tiled
from sfms_robot.corpora.compose.motions import KINDS, SPLITS, edges
from sfms_robot.corpora.compose.motions import load as load_motions
from sfms_robot.corpora.compose.voices import lay, read_voice
from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.frames import BLENDSHAPES, CHANNEL_INDEX, FRAME_HZ, POSE, SHAPES
from sfms_robot.signals.events import find_blinks, find_nods, phrase_ends, voice_activity

PITCH = CHANNEL_INDEX["pitch"]
VOICES = [data_dir("sim") / "speakers"]
MOTIONS = data_dir("sim") / "listeners" / "motions.npz"
UNTIL_S = 240.0

NONE = np.zeros((0, 2))


def score(seconds, **events):
    spans = {name: NONE for name in ("nods", "shakes", "tilts", "laughs", "talk", "backchannels", "shared_laughs")}
    given = {"gaze": (), "asked": np.zeros(0), "ends": np.zeros(0)} | spans | events
    return Score(int(seconds * FRAME_HZ), **given)


@pytest.fixture(scope="module")
def motions():
    return load_motions(MOTIONS)


@pytest.fixture(scope="module")
def katie():
    return read_voice(data_dir("sim") / "speakers" / "katie" / "speech.wav")


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """Two series of two people; A talks 3 s of every 4, B nods at each second phrase end and says yes to it."""
    folder = tmp_path_factory.mktemp("ami")
    rows = {name: [] for name in ("participants", "head_gestures", "gaze_focus", "words", "dialogue_acts")}
    for meeting in ("M1a", "M2a"):
        for agent in "AB":
            rows["participants"].append((meeting, agent, f"{meeting}{agent}", "", UNTIL_S, 1, int(agent == "B")))
        for start in np.arange(1, UNTIL_S - 4, 4):
            rows["words"].append((meeting, "A", start, start + 1.5, "w", "well"))
            rows["words"].append((meeting, "A", start + 1.6, start + 3, "w", "so"))
        for end in np.arange(4, UNTIL_S - 4, 8):
            rows["head_gestures"].append((meeting, "B", end + 0.2, end + 0.9, "concord_signal", "nod"))
            rows["words"].append((meeting, "B", end + 0.3, end + 0.6, "w", "yes"))
            rows["dialogue_acts"].append((meeting, "B", end + 0.3, end + 0.6, "bck"))
            rows["gaze_focus"].append((meeting, "B", end + 2, end + 4, "place", "table"))
        rows["words"].append((meeting, "B", 101, 101.5, "vocalsound", "laugh"))
    for name, lines in rows.items():
        header = list(ami._COLUMNS[name])
        if name == "participants":
            header = ["meeting", "agent", "participant", "role", "head_annotated_until_s", "n", "has_gaze_focus"]
        with (folder / f"{name}.csv").open("w", newline="") as file:
            csv.writer(file).writerows([header, *lines])
    return folder


@pytest.fixture(scope="module")
def made(tables):
    return composed.compose(tables, VOICES, MOTIONS, seed=3, minutes=3)


def test_one_seed_composes_the_same_dyads_and_another_one_others(tables, made):
    again = composed.compose(tables, VOICES, MOTIONS, seed=3, minutes=3)
    other = composed.compose(tables, VOICES, MOTIONS, seed=4, minutes=3)
    assert [d.name for d in again["train"]] == [d.name for d in made["train"]]
    for one, two in zip(again["train"], made["train"], strict=True):
        np.testing.assert_array_equal(one.listener, two.listener)
        np.testing.assert_array_equal(one.audio, two.audio)
        np.testing.assert_array_equal(one.speaker, two.speaker)
    assert not np.array_equal(other["train"][0].listener[:500], made["train"][0].listener[:500])


def test_meetings_are_kept_apart(made):
    assert {dyad.name[:3] for dyad in made["train"]} == {"M2a"}
    assert {dyad.name[:3] for dyad in made["validation"]} == {"M1a"}


def test_dyads_are_as_long_as_asked_for(made):
    assert sum(len(dyad.listener) for dyad in made["train"]) / FRAME_HZ / 60 == pytest.approx(3, abs=0.8)
    for dyad in made["train"]:
        assert 30 * FRAME_HZ <= len(dyad.listener) <= 60 * FRAME_HZ


def test_phrases_sound_when_they_were_said(tables, made):
    people = {(person.meeting, person.agent): person for person in ami.read_people(tables)}
    for dyad in made["train"]:
        meeting, agent, start = dyad.name.split("_")
        person = people[meeting, agent]
        if not len(person.others) or agent == "A":
            continue
        heard = phrase_ends(voice_activity(dyad.audio), FRAME_HZ)
        for end in person.others[:, 1] - float(start):
            if 1.5 < end < len(dyad.listener) / FRAME_HZ - 1:  # the name rounds the start down to a second
                assert (np.abs(heard - end) < 1.15).any()


def test_nods_are_where_they_were_annotated(made):
    for dyad in made["train"]:
        if "_B_" not in dyad.name:
            continue
        start = float(dyad.name.split("_")[2])
        expected = [t - start for t in np.arange(4.2, UNTIL_S - 4, 8) if 2 < t - start < len(dyad.listener) / 25 - 2]
        found = find_nods(dyad.listener[:, PITCH], FRAME_HZ)
        assert len(found) >= 0.7 * len(expected)
        for onset, _, _ in found:
            assert np.abs(np.array(expected) - onset).min() < 1.3 or not 2 < onset < len(dyad.listener) / 25 - 2


def test_listening_excludes_own_words(made):
    for dyad in made["train"]:
        assert 0.5 < dyad.listening.mean() < 1.0


def test_a_new_set_replaces_the_old_one_and_nothing_else(tables, tmp_path):
    composed.compose_folder(tables, tmp_path, seed=1, minutes=1)
    (tmp_path / "train" / "mine.npz").write_bytes(b"")
    (tmp_path / "train" / "M9z_A_0000.npz").write_bytes(b"")
    composed.compose_folder(tables, tmp_path, seed=1, minutes=1)
    assert (tmp_path / "train" / "mine.npz").exists()
    assert not (tmp_path / "train" / "M9z_A_0000.npz").exists()


def test_written_sets_read_back(tables, tmp_path):
    written = composed.compose_folder(tables, tmp_path, seed=1, minutes=1)
    for split in SPLITS:
        assert sum(len(dyad.listener) for dyad in load(tmp_path / split)) / FRAME_HZ / 60 == pytest.approx(
            written[split]
        )


@pytest.mark.parametrize("seed", range(6))
def test_motion_stays_in_range_and_never_jumps(motions, seed):
    busy = score(
        30,
        nods=np.array([(3.0, 3.4), (8.0, 10.0), (20.0, 20.5)]),
        shakes=np.array([(14.0, 15.0)]),
        laughs=np.array([(24.0, 25.0)]),
        backchannels=np.array([(8.2, 8.6)]),
        talk=np.array([(8.2, 8.6), (26.0, 28.0)]),
        gaze=((5.0, 7.0, "down"), (12.0, 15.0, "side A"), (22.0, 22.8, "away")),
        ends=np.array([3.0, 8.0]),
    )
    motion = listener_motion(busy, motions["train"], np.random.default_rng(seed))
    assert np.isfinite(motion).all()
    assert motion[:, SHAPES].min() >= 0 and motion[:, SHAPES].max() <= 1
    speed = np.abs(np.diff(motion[:, :3], axis=0)) * FRAME_HZ
    bend = np.abs(np.diff(motion[:, :3], n=2, axis=0)) * FRAME_HZ**2
    assert np.rad2deg(speed.max(axis=0) < np.deg2rad([120, 150, 180])).all()
    assert np.rad2deg(bend[:, 1].max()) < 2400


def test_two_listeners_of_the_same_score_differ(motions):
    one, two = (listener_motion(score(10), motions["train"], np.random.default_rng(seed)) for seed in (1, 2))
    assert np.abs(one - two).max() > 0.01


def test_a_listener_to_whom_nothing_happens_still_lives(motions):
    motion = listener_motion(score(60), motions["train"], np.random.default_rng(0))
    assert find_nods(motion[:, PITCH], FRAME_HZ) == []
    assert 8 <= len(find_blinks(motion[:, CHANNEL_INDEX["eyeBlinkLeft"]], FRAME_HZ)) <= 32
    for second in range(0, 60, 5):  # the head never freezes
        assert np.ptp(motion[second * 25 : second * 25 + 125, :3], axis=0).max() > np.deg2rad(0.1)


def test_eyes_keep_their_target_while_the_head_nods(motions):
    motion = listener_motion(score(10, nods=np.array([(4.0, 5.0)])), motions["train"], np.random.default_rng(1))
    nodding = slice(100, 125)
    up = motion[nodding, CHANNEL_INDEX["eyeLookUpLeft"]] - motion[nodding, CHANNEL_INDEX["eyeLookDownLeft"]]
    assert np.corrcoef(up, motion[nodding, PITCH])[0, 1] > 0.7


def test_mirroring_twice_is_nothing(motions):
    motion = listener_motion(score(5), motions["train"], np.random.default_rng(0))
    np.testing.assert_array_equal(mirrored(mirrored(motion)), motion)
    left, right = (BLENDSHAPES.index(f"mouthSmile{side}") for side in ("Left", "Right"))
    np.testing.assert_array_equal(mirrored(motion)[:, SHAPES][:, left], motion[:, SHAPES][:, right])
    np.testing.assert_array_equal(mirrored(motion)[:, POSE][:, 2], -motion[:, POSE][:, 2])


def test_tiles_of_a_constant_are_that_constant():
    pieces = [np.full((length, 3), 0.7, np.float32) for length in (80, 120, 200)]
    np.testing.assert_allclose(tiled(pieces, 700, np.random.default_rng(0)), 0.7, atol=0.06)


def test_stretching_keeps_ends_and_peak():
    curve = edges(20, 8)
    for frames in (10, 20, 47):
        longer = stretched(curve, frames)
        assert len(longer) == frames
        assert longer.max() == pytest.approx(1, abs=0.05) and longer[0] == curve[0]


def test_voice_fills_exactly_the_segments(katie):
    segments = np.array([[1.0, 2.5], [4.0, 9.0], [9.5, 9.8]])
    audio, mouth = lay(segments, 300, katie, np.random.default_rng(0))
    times = np.arange(len(audio)) / 16_000
    inside = np.zeros(len(audio), bool)
    for start, end in segments:
        inside |= (times >= start) & (times < end)
    assert mouth is None
    assert not audio[~inside].any()
    assert phrase_ends(voice_activity(audio), FRAME_HZ)[:2] == pytest.approx([2.5, 9.0], abs=0.13)


def test_a_mouth_moves_only_while_its_voice_sounds():
    voice = read_voice(data_dir("sim") / "speakers" / "facegood_1114_3_16" / "speech.wav")
    _, mouth = lay(np.array([[2.0, 6.0]]), 250, voice, np.random.default_rng(0))
    assert mouth[:, BLENDSHAPES.index("jawOpen")].max() > 0.1
    assert not mouth[:48].any() and not mouth[153:].any()


@pytest.mark.parametrize("split", SPLITS)
def test_bundled_primitives_are_complete_and_in_range(motions, split):
    for kind in KINDS:
        assert getattr(motions[split], kind)
    for curve in motions[split].blinks:
        assert curve.max() == pytest.approx(1, abs=0.01) and curve[0].max() == curve[-1].max() == 0
    for cycle in motions[split].nods:
        assert cycle[0] == cycle[-1] == 0 and cycle.max() == pytest.approx(1, abs=0.01)


def test_gaps_under_a_fifth_of_a_second_are_no_pause():
    assert ami.phrases([(3, 4), (0, 1), (1.1, 2), (0.5, 1.05)]).tolist() == [[0, 2], [3, 4]]


def test_a_missing_table_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"head_gestures.csv.gz: no such file"):
        ami.read_people(tmp_path)


def test_a_missing_column_is_named(tmp_path, tables):
    for file in tables.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    (tmp_path / "words.csv").write_text("meeting,agent,start_s,end_s,kind\n")
    with pytest.raises(ConfigError, match=r"words.csv: column = 'text' is missing"):
        ami.read_people(tmp_path)


def test_minutes_below_zero_are_refused(tables):
    with pytest.raises(ConfigError, match="--minutes -1: must be above 0"):
        composed.compose(tables, VOICES, MOTIONS, seed=1, minutes=-1)


def test_a_folder_without_voices_is_refused(tables, tmp_path):
    with pytest.raises(ConfigError, match="no WAV file to take voices from"):
        composed.compose(tables, [tmp_path], MOTIONS, seed=1, minutes=1)


def test_a_broken_motion_file_is_named(tmp_path):
    (tmp_path / "motions.npz").write_bytes(b"nothing")
    with pytest.raises(ConfigError, match="motions.npz: not a file of motion primitives"):
        load_motions(tmp_path / "motions.npz")
