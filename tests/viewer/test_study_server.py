"""The page of a blind comparison, on a real socket and in a real browser."""

import json
import socket
import threading
import urllib.error
import urllib.request

import numpy as np
import pytest
import soundfile
from chromium import Page, missing

from sfms_robot.lab.evaluation.people_study import Study, clip_name, read_answers
from sfms_robot.viewer.study_server import study_app
from sfms_robot.viewer.web_server import web_server

LIMIT_S = 60.0
QUIET = ("--autoplay-policy=no-user-gesture-required", "--mute-audio")
VOICE_S = 0.6


@pytest.fixture
def study(tmp_path):
    told = {"conditions": ["a", "b"], "voices": ["one", "two"], "seed": 5}
    (tmp_path / "study.json").write_text(json.dumps(told))
    (tmp_path / "clips").mkdir()
    for voice in range(2):
        soundfile.write(tmp_path / "clips" / f"voice-{voice}.wav", np.zeros(round(16_000 * VOICE_S)), 16_000)
        for name in "ab":
            np.zeros((15, 58), "<f4").tofile(tmp_path / "clips" / f"{clip_name(5, name, voice)}.f32")
    return Study(tmp_path)


class Served:
    """The app in a thread of its own, on a port that is free."""

    def __init__(self, app):
        listening = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{listening.getsockname()[1]}/"
        self.server = web_server(app, ws="none")
        self.thread = threading.Thread(target=self.server.run, kwargs={"sockets": [listening]})

    def __enter__(self):
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.server.should_exit = True
        self.thread.join(LIMIT_S)

    def ask(self, path, told=None, **headers):
        data = None if told is None else told if isinstance(told, bytes) else json.dumps(told).encode()
        headers = {"Content-Type": "application/json"} | {k.replace("_", "-"): v for k, v in headers.items()}
        request = urllib.request.Request(self.url + path, data, headers)
        try:
            with urllib.request.urlopen(request, timeout=LIMIT_S) as answer:
                return answer.status, answer.read()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, error.read()


def test_a_person_answers_all(study):
    with Served(study_app(study)) as served:
        begun = json.loads(served.ask("begin", {})[1])
        told = json.loads(served.ask("next", {"participant": begun["participant"]})[1])
        assert served.ask(f"clips/{told['left']}")[0] == 200 and served.ask(f"clips/{told['audio']}")[0] == 200
        while "trial" in told:
            answers = dict.fromkeys(begun["questions"], "right")
            message = {"participant": begun["participant"], "trial": told["trial"], "answers": answers}
            told = json.loads(served.ask("answer", message)[1])
        assert told == {"answered": 2, "trials": 2}
    assert study.results()["sides"] == {"left": 0, "right": 8}


@pytest.mark.parametrize(
    "path, message, told",
    [
        ("next", b"{", b"a message is one JSON object"),
        ("next", b"[]", b"a message is one JSON object"),
        ("next", b"{}", b"participant: expected the name that /begin returned"),
        ("next", {"participant": "../../etc"}, b"participant: expected the name that /begin returned"),
        ("answer", {"participant": "me"}, b"an answer needs a number `trial` and a table `answers`"),
        ("answer", {"participant": "me", "trial": 9, "answers": {}}, b"trial = 9 is not one of this study"),
        ("next", b" " * 5000, b"a message of more than 4096 bytes"),
    ],
)
def test_nonsense_gets_one_line(study, path, message, told):
    with Served(study_app(study)) as served:
        status, said = served.ask(path, message)
        assert status == 400 and told in said and served.ask("begin", {})[0] == 200


def test_strangers_and_files_beside_the_clips_are_refused(study):
    with Served(study_app(study, token="secret")) as served:
        assert served.ask("begin", {})[0] == 400 and served.ask("begin", {}, X_Token="secret")[0] == 200
        assert served.ask("", None, Host="evil.example")[0] == 403
        assert served.ask("clips/../study.json")[0] == 404 and served.ask("clips/%2e%2e/study.json")[0] == 404
        assert served.ask("")[0] == 200 and served.ask("static/people.js")[0] == 200
        assert served.ask("human/head.bin")[0] == 200


@pytest.mark.slow
@pytest.mark.skipif(missing() is not None, reason=f"needs {missing()}")
def test_in_a_browser_by_keys(study, tmp_path):
    with Served(study_app(study)) as served, Page(tmp_path / "chromium", *QUIET) as page:
        page.driver.get(served.url)
        page.until("!document.getElementById('trial').hidden")
        keys(page.driver, "\ue012")  # arrow left, before anything was seen
        assert not study.results()["answers"]
        for side in ("1", "2"):
            keys(page.driver, side)
            page.until("!document.body.dataset.playing")
        page.until("!document.querySelector('fieldset').disabled")
        for arrow in "\ue012\ue014\ue015\ue012":  # left, right, down, left
            keys(page.driver, arrow)
        page.until("document.getElementById('progress').value == 1")
        assert page.complaints() == []
    given = read_answers(study.folder / "answers.csv")
    sides = ["neither" if a.chosen == "neither" else "left" if a.chosen == a.left else "right" for a in given]
    assert sides == ["left", "right", "neither", "left"]


def keys(browser, text):
    browser.find_element("tag name", "body").send_keys(text)
