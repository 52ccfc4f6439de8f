"""ARIG on half a minute of made-up conversation: it learns, repeats, resumes, and hears what it should."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from tiny_arig_training import HZ, dyad, settings, write

from sfms_robot import config
from sfms_robot.config.listener import STATES
from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNELS, FRAME_SAMPLES, ListenerEvent, SpeakerFrame
from sfms_robot.lab.learning.arig import trainer
from sfms_robot.lab.learning.arig.features import SCENES, cut, fit_scales, gather, open_scenes, reflection
from sfms_robot.lab.learning.train_runs import TrainOptions, train_settings
from sfms_robot.listeners import audio_frontend
from sfms_robot.listeners.arig.event_curves import features
from sfms_robot.listeners.arig.model import ArigModel
from sfms_robot.listeners.arig.stream import FIRST, NODDING
from sfms_robot.listeners.audio_frontend import MEL_WIDTH, hear_each
from sfms_robot.listeners.registry import load_folder
from sfms_robot.listeners.space import MotionSpace
from sfms_robot.signals.mel import FLOOR, LN_PER_DB

ARKIT = MotionSpace("arkit58", np.zeros(58))
WINDOW = 24
SWAYS = {"events": True, "draws": "innovation", "sway": True}
ABLATIONS = (
    {"state_guidance": False}, {"visual": False}, {"interaction": "linear"}, {"context_chunks": 4}, {"draws": "step"},
    {"events": True, "draws": "innovation"},
)  # fmt: skip
A_LISTENER, A_TOLD = (settings(listener={"events": events}).listener for events in (False, True))


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def corpus(data):
    return gather(open_scenes(data, "train"), WINDOW, ARKIT, A_LISTENER)


def a_student(**changes) -> trainer.Student:
    torch.manual_seed(0)
    return trainer.Student(ArigModel(settings(listener=changes).listener))


def fitted(corpus, **changes) -> ArigModel:
    model = a_student(**changes).model
    fit_scales(model, corpus)
    return model


def quiet(**changes) -> config.ArigPhase:
    """A phase that leaves windows as they are, but for `changes`."""
    noises = ("history_noise", "speaking_noise", "state_noise")
    off = {name: 0 for name in (*noises, "drop_audio", "drop_face", "drop_agent", "gain_db", "colour_db", "grain_db")}
    return settings(**(off | changes)).training


def augmented(told, model: ArigModel | None = None, **changes):
    return trainer.augment(told, model or a_student().model, quiet(**changes), torch.Generator().manual_seed(0))


def one_window(corpus):
    """The same window 400 times."""
    return cut(corpus, corpus.starts_by_scene(WINDOW)["interaction"][:1].repeat(400), WINDOW)


@pytest.mark.parametrize(
    "changes",
    [{}, {"discrete": True}, SWAYS, *(pytest.param(each, marks=pytest.mark.slow) for each in ABLATIONS)],
    ids=lambda changes: "-".join(changes) or "full",
)
def test_every_ablation_trains_into_a_listener_that_streams(data, tmp_path, changes):
    figures = trainer.train_arig(settings(listener=changes, steps=4), data, tmp_path)
    assert figures["steps"] == 4 and np.isfinite(figures["held_out_noise"])
    listener, silence = load_folder(tmp_path), np.zeros(FRAME_SAMPLES, np.float32)
    plan, _ = listener.step(SpeakerFrame(0.04, silence, None, silence), listener.start(1))
    assert plan.frames.shape == (1, 58) and np.isfinite(plan.frames).all()


@pytest.mark.slow
@pytest.mark.parametrize("changes", [{}, {"discrete": True}, {"interaction": "linear"}], ids=str)
def test_it_trains_in_16_bits(data, tmp_path, monkeypatch, changes):
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: True)
    figures = trainer.train_arig(settings(listener=changes, steps=3, precision="bf16"), data, tmp_path)
    assert np.isfinite(figures["loss"])


@pytest.mark.slow
def test_losses_fall(data, tmp_path):
    few = trainer.train_arig(settings(steps=2), data, tmp_path / "few")
    more = trainer.train_arig(settings(steps=60), data, tmp_path / "more")
    for part in ("noise", "state", "coarse"):
        assert more[f"held_out_{part}"] < 0.9 * few[f"held_out_{part}"]


def test_the_curriculum_decides_where_windows_come_from(corpus):
    phase, starts = settings(steps=100).training, corpus.starts_by_scene(WINDOW)
    generator = torch.Generator().manual_seed(0)
    first_of = {scene: (int(starts[scene].min()), int(starts[scene].max())) for scene in SCENES}
    early = trainer.draw(starts, trainer.weights_of(phase.stage(0), starts), 50, generator)
    low, high = first_of["speaking"]
    assert ((early >= low) & (early <= high)).all()
    late = trainer.draw(starts, trainer.weights_of(phase.stage(99), starts), 300, generator)
    shares = [((late >= low) & (late <= high)).float().mean() for low, high in first_of.values()]
    assert min(shares) > 0.05 and sum(shares) == pytest.approx(1)


def test_without_the_sets_that_speak_the_curriculum_goes_on_with_listening(data, tmp_path, caplog):
    shutil.copytree(data / "train", tmp_path / "train")
    shutil.copytree(data / "validation", tmp_path / "validation")
    whole = settings(steps=2, stages=[{"share": 1.0, "speaking": 1.0, "listening": 1.0}])
    assert trainer.train_arig(whole, tmp_path, tmp_path / "out")["steps"] == 2
    assert "no train, the curriculum continues without it" in caplog.text
    with pytest.raises(ConfigError, match="a stage draws from speaking alone, the data have listening"):
        trainer.train_arig(settings(steps=2), tmp_path, tmp_path / "out2")


def test_a_silent_agent_may_lack_its_track_and_dropping_takes_a_whole_modality_and_its_voice(corpus):
    starts = corpus.starts_by_scene(WINDOW)
    told = cut(corpus, torch.cat([starts["speaking"][:20], starts["listening"][:20]]), WINDOW)
    found, _ = augmented(told, drop_agent=1)
    speaks = told.voiced[..., 0].any(1)
    assert speaks.any() and not speaks.all() and torch.equal(found.agent_heard.any(1), speaks)
    told = cut(corpus, corpus.starts_by_scene(WINDOW)["interaction"][:10], WINDOW)
    found, _ = augmented(told, drop_audio=1, drop_face=1)
    assert told.voiced[..., 1].any()
    assert not (found.user_heard.any() or found.voiced[..., 1].any() or found.user_seen.any())
    assert torch.equal(found.voiced[..., 0], told.voiced[..., 0])


def test_a_quiet_room_takes_from_what_is_no_speech_down_to_digital_silence(corpus):
    starts = corpus.starts_by_scene(WINDOW)["interaction"]
    heard = cut(corpus, starts, WINDOW).voiced[..., 1].float().mean(1)
    told = cut(corpus, starts[heard.sub(0.5).abs().argmin()].repeat(200), WINDOW)  # now speech, now none
    room = torch.zeros_like(told.user_sound)
    room[..., :MEL_WIDTH] = 3.0
    told = replace(told, user_sound=told.user_sound + room)
    found, _ = augmented(told, quiet_room=1)
    voiced, floor = told.voiced[..., 1], np.log(FLOOR)
    assert voiced.any() and not voiced.all() and torch.equal(found.user_sound[voiced], told.user_sound[voiced])
    before, after = (each.user_sound[..., :MEL_WIDTH][~voiced] - floor for each in (told, found))
    left = after.sum(-1) / before.sum(-1)
    assert (after <= before + 1e-5).all() and (after > -1e-2).all()
    assert float(left.min()) < 0.05 and float(left.max()) > 0.95
    assert torch.equal(found.user_sound[..., MEL_WIDTH:], told.user_sound[..., MEL_WIDTH:])
    assert torch.equal(found.agent_sound, told.agent_sound) and torch.equal(found.voiced, told.voiced)


def test_a_silent_user_is_heard_as_a_stream_hears_silence(corpus):
    told = cut(corpus, corpus.starts_by_scene(WINDOW)["interaction"][::9][:10], WINDOW)
    found, _ = augmented(told, silent_user=1)
    state, heard = audio_frontend.TRACKS.start(), []
    for _ in range(WINDOW):
        sound, _, (state,) = hear_each([np.zeros(FRAME_SAMPLES, np.float32)], [state])
        heard.append(sound[0])
    assert torch.equal(found.user_sound, torch.from_numpy(np.stack(heard)).expand(10, -1, -1))
    assert told.voiced[..., 1].any() and not found.voiced[..., 1].any()
    assert torch.equal(found.user_heard, told.user_heard)


def test_another_microphone_colours_a_window_smoothly_and_leaves_the_phrase_alone(corpus):
    told = one_window(corpus)
    off = augmented(told, colour_db=6.0)[0].agent_sound - told.agent_sound  # (400, N, A)
    bands = off[..., :MEL_WIDTH].unflatten(-1, (4, 128))
    assert torch.allclose(bands, bands[:, :1, :1].expand_as(bands), atol=1e-5)
    assert 0.2 < float(bands.std()) / (6 * LN_PER_DB) < 0.6
    assert float(bands.diff(dim=-1).abs().amax()) < 0.15 * float(bands.abs().amax())
    assert not off[..., MEL_WIDTH:].any()


def test_half_of_the_pasts_are_off_and_what_comes_after_goes_a_tenth_of_the_way_back(corpus):
    model = fitted(corpus)
    model.step_std.zero_()  # leaves the slow part alone
    told = one_window(corpus)
    told = replace(told, voiced=torch.zeros_like(told.voiced))
    found, truth = augmented(told, model, history_noise=0.4)
    off = (found.agent_motion - told.agent_motion) / model.motion_std
    assert float((off.flatten(1).abs().amax(1) < 1e-4).float().mean()) == pytest.approx(0.67, abs=0.1)  # 0.3 never jump
    after = (truth - told.agent_motion) / model.motion_std
    assert torch.allclose(after[:, 1:], 0.9 * off[:, :-1], atol=1e-4)


def test_lips_of_who_speaks_are_off_by_more_and_where_its_sounds_put_them_at_once(corpus):
    model, told = fitted(corpus), one_window(corpus)
    speaks = torch.zeros_like(told.voiced)
    speaks[:, WINDOW // 2 :, 0] = True
    told = replace(told, voiced=speaks)
    found, truth = augmented(told, model, history_noise=0.4, speaking_noise=1.0)
    off = ((found.agent_motion - told.agent_motion) / model.motion_std)[:, WINDOW // 2 :]
    lips = torch.tensor([name.startswith(("jaw", "mouth", "tongue")) for name in CHANNELS])
    assert float(off[..., lips].std()) > 3 * float(off[..., ~lips].std()) > 0
    assert torch.equal(truth[:, WINDOW // 2 :, lips], told.agent_motion[:, WINDOW // 2 :, lips])
    assert not torch.equal(truth[:, WINDOW // 2 :, ~lips], told.agent_motion[:, WINDOW // 2 :, ~lips])


@pytest.mark.parametrize("draws", ["motion", "step", "innovation"])
def test_what_is_drawn_is_the_inverse_of_what_is_learned(corpus, draws):
    model = fitted(corpus, draws=draws)
    motion = model.standardise(corpus.frames.agent_motion)
    last = motion.roll(1, 0)
    assert torch.allclose(model.drawn(model.moved(motion, last), last), motion, atol=1e-4)


def test_steps_from_one_dyad_into_the_next_are_no_steps(corpus):
    model = fitted(corpus, draws="step")
    motion = model.standardise(corpus.frames.agent_motion).split(corpus.lengths)
    largest = torch.stack([(one.diff(dim=0) / model.step_std).abs().amax(0) for one in motion]).amax(0)
    assert torch.allclose(torch.maximum(model.head.high, -model.head.low), largest, atol=1e-3)


def test_a_step_never_leads_out_of_the_range_of_the_motion():
    model = a_student(draws="step").model
    model.motion_high.fill_(0.5)
    assert float(model.drawn(torch.full((1, 58), 9.0), torch.zeros(1, 58)).max()) == 0.5


def test_lost_states_are_drawn_and_unknown_ones_wait():
    states = torch.tensor([[3, -1] * 500])
    assert torch.equal(trainer.previous_states(states, 0, torch.Generator(), 7)[0, :2], torch.tensor([3, FIRST]))
    kept = trainer.previous_states(states, 0.7, torch.Generator().manual_seed(0), 7)[:, ::2] == 3
    assert float(kept.float().mean()) == pytest.approx(0.3 + 0.7 / 7, abs=0.05)


@pytest.mark.parametrize("own", [True, False])
def test_states_that_are_fed_back_do_not_come_from_the_labels(corpus, own):
    student = a_student()
    told = cut(corpus, corpus.starts_by_scene(WINDOW)["interaction"][:3], WINDOW)
    phase = quiet(own_states=own)
    with torch.no_grad():
        first, second = (
            trainer.loss_parts(student, told, states, told.agent_motion, phase, torch.Generator().manual_seed(0)).motion
            for states in (torch.zeros_like(told.states), torch.full_like(told.states, 4))
        )
    assert torch.equal(first, second) == own


def test_a_change_of_one_key_leaves_its_neighbours(tmp_path):
    file = tmp_path / "arig.yaml"
    file.write_text(yaml.safe_dump(settings().model_dump(mode="json")))
    options = TrainOptions(
        file=file, data=tmp_path, out=tmp_path, seed=3, changes={"diffusion": {"schedule": "logarithmic"}},
        phase_changes={"own_states": True},
    )  # fmt: skip
    found = train_settings(options)
    assert found.seed == 3 and found.training.own_states and found.training.steps == settings().training.steps
    assert found.listener.diffusion == settings().listener.diffusion.model_copy(update={"schedule": "logarithmic"})


def test_agent_and_user_keep_their_tracks():
    found = gather({"speaking": [dyad("a", "speaking", 0)]}, WINDOW, ARKIT, A_LISTENER)
    frames = found.frames
    assert frames.agent_heard.all() and not frames.user_heard.any() and not frames.user_seen.any()
    assert frames.voiced[:, 0].any() and not frames.voiced[:, 1].any() and len(frames.states) == HZ * 12


@pytest.mark.parametrize(
    ("raw", "said"),
    [
        ({"stages": [{"share": 0.5, "speaking": 1}]}, "shares of the stages add up to 0.5, not 1"),
        ({"stages": [{"share": 1.0}]}, "a stage needs a weight above 0 .speaking, listening, interaction."),
        ({"history_noise": -1}, "history_noise"),
    ],
)
def test_what_is_wrong_in_a_training_file_is_said(raw, said):
    with pytest.raises(ConfigError, match=said):
        settings(**raw)


def test_a_dyad_whose_events_nobody_knows_cannot_teach_a_listener_with_events(data):
    blank = replace(dyad("blank", "listening", 0), events=None)
    with pytest.raises(ConfigError, match="blank: expected events of its listener"):
        gather({"listening": [blank]}, WINDOW, ARKIT, A_TOLD)
    assert gather({"listening": [blank]}, WINDOW, ARKIT, A_LISTENER).frames.control.shape[-1] == 0


def test_gaze_is_not_among_what_is_learned_with_events():
    looks = np.zeros((HZ * 12, 3), np.float32)
    looks[:, 2] = np.linspace(-0.3, 0.3, len(looks))
    one = dyad("a", "listening", 0)
    motion = one.listener.copy()
    motion[:, :3] += looks
    motion[:, [CHANNELS.index("eyeLookInLeft"), CHANNELS.index("eyeLookUpRight")]] = 0.4
    seen = gather({"a": [replace(one, listener=motion, head_of_gaze_rad=looks)]}, WINDOW, ARKIT, A_TOLD)
    still = gather({"a": [one]}, WINDOW, ARKIT, A_TOLD)
    assert torch.allclose(seen.frames.agent_motion, still.frames.agent_motion, atol=1e-6)
    assert torch.equal(seen.frames.control, still.frames.control) and seen.frames.control.any()


def test_feedback_that_is_seen_has_states_of_its_own():
    one = dyad("a", "listening", 1)
    found = gather({"a": [one]}, WINDOW, ARKIT, A_TOLD).frames
    nods = found.control[:, 0] > 0
    listening = torch.from_numpy(one.states == STATES.index("listening"))
    assert torch.equal(found.states == NODDING, nods & listening) and bool((nods & listening).any())


def test_windows_of_events_have_every_kind_as_often_but_blinks():
    smile, nods = ListenerEvent("smile", 10.0, 1.0, 0.5), (ListenerEvent("nod", at, 0.4, 0.05) for at in range(9))
    blinks = (ListenerEvent("blink", at + 0.5, 0.2, 0.9) for at in range(11))
    one = replace(dyad("a", "listening", 0), events=(*nods, smile, *blinks))
    corpus = gather({"listening": [one]}, WINDOW, ARKIT, A_TOLD)
    starts = corpus.starts_by_scene(WINDOW)
    eventful, drawn = trainer.starts_by_event(corpus, starts, WINDOW), torch.Generator().manual_seed(0)
    smiles = trainer.draw(starts, torch.tensor([0.0, 1.0, 0.0]), 400, drawn, eventful, 1.0) + WINDOW > 10 * HZ - 1
    assert len(eventful["listening"]) == 2 and 0.4 < float(smiles.float().mean()) < 0.7


def test_the_fitted_autoregression_is_that_of_the_motion():
    rng, rho = np.random.default_rng(0), 0.9
    place = [np.zeros(58)]
    for draw_ in rng.normal(0, 0.02, (4000, 58)):
        place.append(rho * place[-1] + draw_)
    motion = torch.tensor(np.stack(place), dtype=torch.float32)
    assert torch.allclose(reflection(motion[:-1], motion[1:]), torch.full((58,), rho), atol=0.03)
    assert float(reflection(torch.ones(9, 1), torch.ones(9, 1))) == 1.0
    assert float(reflection(torch.zeros(9, 1), torch.zeros(9, 1))) == 1.0


def of_motion(motion: np.ndarray) -> ArigModel:
    """Scales of a model whose head sways apart, fitted on motion (N, 58) of one dyad without events."""
    one = dyad("a", "listening", 0)
    frames = len(one.listener)
    made = [
        replace(one, name=f"a{at}", listener=motion[at : at + frames].astype(np.float32), events=())
        for at in range(0, len(motion) - frames + 1, frames)
    ]
    model = a_student(**SWAYS).model
    fit_scales(model, gather({"listening": made}, WINDOW, ARKIT, model.settings))
    return model


def test_how_a_head_sways_is_apart_and_what_is_left_of_it_is_soon_forgotten():
    """Sway of 0.1 and 0.4 Hz is fitted as sway; a residual with a memory of two frames is left beside it."""
    rng, times_s = np.random.default_rng(0), np.arange(9000)[:, None] / HZ
    slow = 0.02 * np.sin(2 * np.pi * 0.1 * times_s + np.arange(58)) + 0.01 * np.sin(2 * np.pi * 0.4 * times_s)
    fast = [np.zeros(58)]
    for draw_ in rng.normal(0, 0.004, (len(slow) - 1, 58)):
        fast.append(0.5 * fast[-1] + draw_)
    model = of_motion(slow + fast)
    power = (model.sway_mixture @ model.sway_mixture.mT).diagonal(dim1=-2, dim2=-1).sum(0)
    assert torch.allclose(power.sqrt(), torch.tensor((0.02**2 / 2 + 0.01**2 / 2) ** 0.5), rtol=0.15)
    assert float(model.rho[:6].max()) < 0.6 and float(model.rho[6:].min()) > 0.9


def test_who_speaks_is_no_model_of_how_a_listener_sways():
    one, rng = dyad("a", "listening", 0), np.random.default_rng(0)
    still, lively = (scale * np.cumsum(rng.normal(0, 1, one.listener.shape), axis=0) for scale in (1e-4, 1e-2))
    of = {name: [replace(one, listener=motion.astype(np.float32), events=())]
          for name, motion in (("listening", still), ("speaking", lively))}  # fmt: skip
    both, alone = a_student(**SWAYS).model, a_student(**SWAYS).model
    for model, scenes in ((both, of), (alone, {"listening": of["listening"]})):
        fit_scales(model, gather(scenes, WINDOW, ARKIT, model.settings))
    assert torch.equal(both.sway_mixture, alone.sway_mixture) and bool(alone.sway_mixture.any())


@pytest.mark.parametrize("seed", range(5))
def test_no_motion_can_be_fitted_by_a_head_that_grows(seed):
    """Smooth, square, growing or constant: what was drawn is less and less."""
    rng, time = np.random.default_rng(seed), np.arange(600)[:, None]
    kinds = [np.sin(time * rng.uniform(0.01, 3.0, 58)), np.sign(np.sin(time * rng.uniform(0.01, 1.0, 58))),
             np.exp(time / 200) * np.ones(58), time * np.ones(58), np.ones((600, 58))]  # fmt: skip
    model = of_motion(0.1 * kinds[seed] + 0.2)
    assert 0 <= float(model.rho.min()) and float(model.rho.max()) < 1 and bool(model.sway_mixture.isfinite().all())


def test_how_far_a_face_goes_at_rest_is_that_of_one_that_nothing_moves():
    """Small where nothing happens, large while it raises its brows or talks: the small one counts."""
    one, rng = dyad("a", "listening", 0), np.random.default_rng(0)
    frames = len(one.listener)
    half, sample = frames // 2, len(one.agent_audio) // frames
    brows = ListenerEvent("brow_raise", half / HZ, half / HZ / 2, 0.5)
    motion = rng.uniform(-0.01, 0.01, one.listener.shape)
    motion[half:] *= 20
    said = rng.normal(0, 0.2, len(one.agent_audio)).astype(np.float32)
    said[: (half + 1) * sample] = 0
    still = replace(one, listener=(0.2 + motion).astype(np.float32), events=(brows,), agent_audio=said)
    model = a_student(**SWAYS).model
    fit_scales(model, gather({"listening": [still] * 3}, WINDOW, ARKIT, model.settings))
    rests = (model.rest_range * model.motion_std)[model.is_drawn & model.is_recalled]
    assert float(rests.max()) < 0.05


def test_a_head_whose_past_is_not_told_is_as_it_was(data):
    model = a_student(**SWAYS).model
    corpus = gather(open_scenes(data, "train"), WINDOW, ARKIT, model.settings)
    told = cut(corpus, corpus.starts_by_scene(WINDOW)["interaction"][:50], WINDOW)
    fit_scales(model, corpus)
    found, truth = augmented(told, model, history_noise=1.0)
    assert torch.equal(found.agent_motion[..., :6], told.agent_motion[..., :6])
    assert torch.equal(truth[..., :6], told.agent_motion[..., :6])
    assert not torch.equal(found.agent_motion[..., 6:], told.agent_motion[..., 6:])


def test_what_events_do_on_average_is_fitted_on_the_data_and_has_no_side():
    one = dyad("a", "listening", 0)
    motion, bump = np.zeros_like(one.listener), np.sin(np.linspace(0, np.pi, 15))
    for event in one.events:
        at = round(event.start_s * HZ)
        motion[at : at + 15, :3] += 0.05 * bump[:, None]
    corpus = gather({"a": [replace(one, listener=motion)]}, WINDOW, ARKIT, A_TOLD)
    model = fitted(corpus, events=True, draws="innovation")
    found = features(corpus.frames.control) @ model.told
    standard = model.standardise(corpus.frames.agent_motion)
    assert float(torch.corrcoef(torch.stack([found[:, 1], standard[:, 1]]))[0, 1]) > 0.95
    assert not found[:, [0, 2, 4]].any()  # roll, yaw, y


def test_states_are_known_by_how_long_they_last_and_by_the_voices_they_go_with(corpus):
    model = fitted(corpus, events=True)
    speaking, listening = STATES.index("speaking"), STATES.index("listening")
    assert model.states.durations[speaking].max() == HZ and model.states.durations[speaking].min() >= 1
    assert model.states.possible[1, 0, speaking] and not model.states.possible[1, 0, listening]
    assert model.states.possible[0, 1, listening] and not model.states.possible[0, 1, speaking]
    assert model.states.possible.any(-1).all()
