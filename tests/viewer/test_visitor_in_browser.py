"""The visitor as the person who is listened to: a browser whose microphone and camera are files."""

import numpy as np
import pytest
import soundfile
from chromium import Page, ServedRun, missing

from sfms_robot.data import data_dir
from sfms_robot.face.drawing import VirtualWebcam
from sfms_robot.frames import CHANNEL_INDEX, MOTION_DIM

pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(missing()), reason=f"needs {missing()}"), pytest.mark.realtime]

VOICE = data_dir("sim") / "speakers" / "katie" / "speech.flac"
FRAMES = 50


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """A person who opens and shuts the mouth, as Chromium's fake camera plays it: raw pictures, 4:2:0."""
    webcam, file = VirtualWebcam(), tmp_path_factory.mktemp("film") / "face.y4m"
    with file.open("wb") as out:
        out.write(b"YUV4MPEG2 W640 H480 F25:1 Ip A1:1 C420jpeg\n")
        for number in range(FRAMES):
            motion = np.zeros(MOTION_DIM, np.float32)
            motion[CHANNEL_INDEX["jawOpen"]] = 0.6 * (number >= FRAMES // 2)
            red, green, blue = webcam.picture(motion).astype(np.float32).transpose(2, 0, 1)
            luma = 0.299 * red + 0.587 * green + 0.114 * blue
            out.write(b"FRAME\n" + luma.round().astype(np.uint8).tobytes())
            for colour, scale in ((blue, 0.564), (red, 0.713)):
                chroma = (128 + scale * (colour - luma)).reshape(240, 2, 320, 2).mean(axis=(1, 3))
                out.write(chroma.clip(0, 255).round().astype(np.uint8).tobytes())
    return file


@pytest.fixture(scope="module")
def page(tmp_path_factory, film):
    assert soundfile.info(VOICE).channels == 1
    voice = tmp_path_factory.mktemp("voice") / "speech.wav"  # Chromium's fake microphone plays nothing else
    soundfile.write(voice, *soundfile.read(VOICE, dtype="int16"))
    flags = (
        "--use-fake-ui-for-media-stream", "--use-fake-device-for-media-stream",
        f"--use-file-for-fake-audio-capture={voice}", f"--use-file-for-fake-video-capture={film}",
    )  # fmt: skip
    with (
        ServedRun(
            "run", "--port", "sim", "--head", "op3_head", "--audio", "browser", "--face", "browser", "--seed", "1",
            "--duration", "3000",
        ) as run,
        Page(tmp_path_factory.mktemp("chromium"), *flags) as page,
    ):  # fmt: skip
        yield page.open(run.url)


def test_the_face_moves_while_the_microphone_hears_a_voice(page):
    page.press("Use my microphone")
    page.until("page.visitor.sent.voice > 50000")
    assert "Sent now" in page.ask("document.querySelector('.sent').textContent")
    page.until("page.newest.db !== null && page.timeline.frames.some(({talk}) => talk)")
    page.until("page.newest.talk && page.stage.seen")
    page.driver.execute_script(
        "globalThis.before = {seen: page.stage.seen, points: page.stage.human.posed.positions.slice()}"
    )
    page.until("page.stage.seen.some((value, i) => Math.abs(value - before.seen[i]) > 0.05)")
    moved_m = (
        "page.stage.human.posed.positions.reduce((most, at, i) => Math.max(most, Math.abs(at - before.points[i])), 0)"
    )
    page.until(f"{moved_m} > 0.001")
    page.press("Stop the microphone")
    page.until("!page.visitor.talking")
    sent = page.ask("page.visitor.sent.voice")
    page.drawn()
    assert page.ask("page.visitor.sent.voice") == sent


def test_the_camera_becomes_58_numbers_and_asks_nobody_but_this_machine(page):
    page.ask("page.visitor.addEventListener('face', ({detail}) => { page.face = detail && [...detail]; }) || 1")
    page.press("Use my camera")
    jaw = CHANNEL_INDEX["jawOpen"]
    page.until(f"page.face && page.face[{jaw}] > 0.2")
    page.until(f"page.face && page.face[{jaw}] < 0.1")
    assert page.ask("page.face.length") == MOTION_DIM
    page.until("page.visitor.sent.face > 2000")
    assert page.addresses() <= {"127.0.0.1", "data", "blob", "about"}
    page.press("Stop the camera")
