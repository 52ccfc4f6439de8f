"""`sfms-robot fleet` beside a router: a page that says where it is, and options where they belong."""

import json
import signal
import socket
import subprocess
import sys
from urllib.request import urlopen

import pytest

from sfms_robot.network import close_session, serve_session, session_config

COMMAND = [sys.executable, "-c", "from sfms_robot.cli.main import main; main()", "fleet"]


@pytest.fixture
def zenoh(tmp_path):
    """A file that leads to a router of its own."""
    pytest.importorskip("zenoh", reason="needs the extra [remote]")
    with socket.create_server(("127.0.0.1", 0)) as free:
        endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    file = tmp_path / "robot.json5"
    file.write_text(
        json.dumps(
            {"mode": "client", "connect": {"endpoints": [endpoint]}, "scouting": {"multicast": {"enabled": False}}}
        )
    )
    router = serve_session(session_config("serve", None, endpoint))
    yield file
    close_session(router)


@pytest.mark.parametrize("ending", [signal.SIGTERM, signal.SIGINT])
def test_a_page_says_where_it_is_as_json_and_serves_until_it_is_told_to_stop(zenoh, ending):
    words = ["page", "--port", "0", "--zenoh", str(zenoh), "--json"]
    with subprocess.Popen([*COMMAND, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        told = json.loads(process.stdout.readline())
        with urlopen(f"{told['url']}heads") as answer:
            assert json.load(answer) == {"heads": []}
        process.send_signal(ending)
        rest, error = process.communicate(timeout=30)
    assert (process.returncode, rest, error) == (0, "", "")


@pytest.mark.parametrize("words", [("--zenoh", "file.json5"), ("--json",)])
def test_an_option_before_the_command_is_not_dropped(command_line, words):
    ended = command_line("fleet", *words, "halt")
    assert ended.code == 2 and f"fleet halt {words[0]}" in ended.complaint
