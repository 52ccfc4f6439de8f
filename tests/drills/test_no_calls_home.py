"""No command talks to anybody but this computer."""

import json
import signal
import sys

import pytest
from drill_rig import HEAD, Command, command

OF_THIS_COMPUTER = {sys.executable, "/sbin/ldconfig", "pactl"}  # where PortAudio is; what the sound server records
WATCHER = """
import json, os, socket, sys

def look(event, arguments):
    if event in ("socket.connect", "socket.sendto", "socket.sendmsg"):
        note("unix" if arguments[0].family == socket.AF_UNIX else "network", arguments[1])
    elif event in ("socket.getaddrinfo", "socket.gethostbyname"):
        note(event, arguments[0])
    elif event == "subprocess.Popen":
        note(event, str(arguments[0]))

def note(kind, address):
    line = json.dumps([kind, str(address)]) + "\\n"
    with open(os.environ["ADDRESSES"], "a") as file:
        file.write(line)

sys.addaudithook(look)
"""


@pytest.fixture
def watch(tmp_path):
    """How to start a command under the watcher, and what it and its children have addressed."""
    folder = tmp_path / "watcher"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(WATCHER)
    addresses = tmp_path / "addresses"
    addresses.touch()
    return {"paths": [str(folder)], "ADDRESSES": str(addresses)}, lambda: [
        tuple(json.loads(line)) for line in addresses.read_text().splitlines()
    ]


def strangers(seen):
    """Addresses beyond this computer, and programs that are not this Python."""
    programs = [address for kind, address in seen if kind == "subprocess.Popen" and address not in OF_THIS_COMPUTER]
    return programs + [address for kind, address in seen if kind not in ("unix", "subprocess.Popen")]


def test_the_watcher_sees_what_a_command_addresses(watch, device):
    how, seen = watch
    command("servo", "scan", "--port", "socket://localhost:1", **how)
    assert "localhost" in strangers(seen())


@pytest.mark.parametrize(
    "words",
    [
        ["--help"],
        ["head", "list"],
        ["head", "check", HEAD],
        ["head", "show", HEAD],
        ["listener", "list"],
        ["speaker", "list"],
        ["port", "list"],
        ["servo", "maps"],
    ],
    ids=" ".join,
)
def test_commands_that_look_something_up_address_nobody(watch, words):
    how, seen = watch
    code, _, err = command(*words, **how)
    assert code == 0, err
    assert strangers(seen()) == []


@pytest.mark.slow
def test_commands_that_listen_move_and_read_stay_on_this_computer(watch, device, tmp_path):
    how, seen = watch
    with Command("emulate", "--head", HEAD, "--link", device, **how) as emulator:
        emulator.until(device.is_symlink)
        for words in (
            ["run", "--head", HEAD, "--port", device, "--audio", "none", "--duration", "0.2"],
            ["servo", "scan", "--ids", "1-2", "--baud", "1000000", "--port", device],
            ["servo", "read", "1", "all", "--baud", "1000000", "--port", device],
            ["doctor", "--head", HEAD, "--port", device],
            ["run", "--head", HEAD, "--fast", "--duration", "1", "--record", tmp_path / "recording"],
            ["replay", tmp_path / "recording", "--json"],
            ["run", "--head", HEAD, "--fast", "--duration", "0.2", "--listener", "arig-small"],
        ):
            code, _, err = command(*words, **how)
            assert code == 0, (words, err)
        emulator.signal(signal.SIGTERM)
        assert emulator.ended().code == 0
    assert strangers(seen()) == []
    assert {kind for kind, _ in seen()} == {"unix", "subprocess.Popen"}  # it looked, into the children too
