"""`--json` on commands that cannot do their work prints one object all the same."""

import signal

import pytest
from drill_rig import HEAD, PAN, Command, command, more_said, torque


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A recorded run of a second."""
    folder = tmp_path_factory.mktemp("recorded") / "run"
    ended = command("run", "--fast", "--head", HEAD, "--duration", "1", "--record", folder)
    assert ended.code == 0, ended.err
    return folder


def nothing(running):
    """It ends by itself."""


def once(running):
    running.signal(signal.SIGINT)


def twice(running):
    once(running)
    running.until(running.heeded)
    once(running)


RUN = ["run", "--audio", "none", "--head", HEAD]


ENDED = [
    (RUN + ["--duration", "1"], nothing, "pan"),
    (RUN + ["--duration", "600"], once, "pan"),
    (RUN + ["--duration", "600"], twice, "pan"),
    (["replay", "RECORDING"], nothing, "pan"),
    (["head", "pose", HEAD, "nod"], nothing, "pan"),
    (["servo", "move", PAN, "--by", "600", "--baud", "1000000"], nothing, "id 1"),
]
SLOW = [pytest.param(*each, marks=pytest.mark.slow) for each in ENDED[1:]]


@pytest.mark.parametrize(("words", "press", "named"), [ENDED[0], *SLOW])
def test_torque_that_is_not_confirmed_off_is_exit_4_and_in_the_object(words, press, named, device, chain, request):
    words = [request.getfixturevalue("recording") if word == "RECORDING" else word for word in words]
    with Command(*words, "--port", device, "--json") as running:
        running.until(lambda: torque(chain)[0] and (words[0] == "servo" or torque(chain)[1]))
        more_said(running, chain, 200)
        chain.kill(PAN)
        press(running)
        ended = running.ended()
    assert (ended.code, "Traceback" in ended.err, torque(chain)) == (4, False, (True, False)), ended.err
    told = ended.told
    assert (told["exit"], told["exit_code"]) == ("failed", 4)
    assert told["error"].startswith(f"torque of {named} could not be confirmed off")
    assert told.get("torque_unconfirmed", ["pan"]) == ["pan"]
