"""A running head as tools of an assistant: called over stdio by the client of the package `mcp`."""

import asyncio
import os
import re
import signal
import subprocess
import sys

import pytest
from websockets.asyncio.server import serve

import sfms_robot as sr

pytest.importorskip("mcp")
from mcp import Client, StdioServerParameters, stdio_client

from sfms_robot.agents.mcp import HeadPage, server

MAIN = [sys.executable, "-c", "from sfms_robot.cli import start; start()"]
RUN = "run --head reachy_mini --listener sfms-small --audio none --duration 90 --view 0.0.0.0:0"
TOOLS = {"show", "expression", "look_at", "calm", "halt", "status"}
CALLS = [  # tool, arguments, what it says; {: an object
    ("status", {}, r"{(?s:.*)reachy_mini"),
    ("show", {"channels": {"yaw": 0.2, "jawOpen": 0.5}, "seconds": 1.0}, "taken; the head is "),
    ("expression", {"name": "smile"}, "taken; the head is "),
    ("look_at", {"x_m": 1.0, "y_m": 0.3, "z_m": 0.1}, "taken; the head is "),
    ("calm", {"rates": {"nod": 2.0, "smile": None}}, "taken; the head is "),
    ("expression", {"name": "smirk"}, r"expression 'smirk' is not there \(.*smile"),
    ("show", {"channels": {"yow": 0.2}}, "yow"),
    ("show", {"channels": {"yaw": "left"}}, "valid number"),
    ("resume", {}, "resume"),
    ("halt", {}, "taken; the head is halted: nothing moves until a person resumes it"),
    ("status", {}, r"{(?s:.*)halted"),
]


@pytest.fixture(scope="module")
def head(tmp_path_factory):
    """A running head, with its page beyond loopback: the address on this machine, and the token."""
    folder = tmp_path_factory.mktemp("head")
    here = os.environ | {"XDG_CONFIG_HOME": str(folder), "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with subprocess.Popen([*MAIN, *RUN.split()], cwd=folder, env=here, stderr=subprocess.PIPE, text=True) as running:
        said = ""
        while not (found := re.search(r":(\d+)/\S*?token=([\w-]+)", said)):
            line = running.stderr.readline()
            assert line, said
            said += line
        yield f"ws://127.0.0.1:{found[1]}", found[2]
        running.terminate()
        running.communicate()


def call(tool, page, **arguments):
    """Call a tool of a server in this process. Return whether it failed, and its text."""

    async def called():
        async with Client(server(page)) as client:
            done = await client.call_tool(tool, arguments)
            return bool(done.is_error), done.content[0].text

    return asyncio.run(called())


@pytest.mark.slow
@pytest.mark.realtime
def test_an_assistant_moves_a_running_head_and_halts_it(head):
    url, token = head

    async def assistant():
        words = [*MAIN[1:], "mcp", "--url", url, "--token", token]
        server_process = StdioServerParameters(command=MAIN[0], args=words, env=dict(os.environ))
        async with Client(stdio_client(server_process)) as client:
            assert {tool.name for tool in (await client.list_tools()).tools} == TOOLS
            return [await client.call_tool(tool, arguments) for tool, arguments, _ in CALLS]

    told = asyncio.run(asyncio.wait_for(assistant(), 80))
    for (tool, _, said), done in zip(CALLS, told, strict=True):
        assert bool(done.is_error) is not said.startswith(("taken", "{")), done.content
        assert re.search(f"{tool}: {said}" if said.startswith("taken") else said, done.content[0].text), tool
    before, after = told[0].structured_content, told[-1].structured_content
    assert "smile" in before["expressions"] and before["state"] != after["state"] == "halted"


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize(
    ("token", "line"),
    [("", "--token: the page needs the token that the run printed"), ("guess", "the token is not the one that was")],
)
def test_a_wrong_token_is_one_line(head, token, line):
    failed, text = call("halt", HeadPage(head[0], token))
    assert failed and line in text and "\n" not in text


@pytest.mark.realtime
def test_ctrl_c_ends_it_while_it_waits_for_stdin():
    here = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with subprocess.Popen(
        [*MAIN, "mcp"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=here, text=True
    ) as running:
        running.stdin.write('{"jsonrpc": "2.0", "id": 1, "method": "ping"}\n')
        running.stdin.flush()
        assert running.stdout.readline().startswith("{")
        running.send_signal(signal.SIGINT)
        assert running.wait(30) == 130


async def garbage(socket):
    await socket.send("\0" * 99)
    await socket.wait_closed()


async def closes(socket):
    await socket.close(1013, "busy")


@pytest.mark.parametrize(
    ("talk", "line"), [(garbage, "expected the page of a run, got"), (closes, "the run closed the connection: 1013")]
)
def test_a_peer_that_is_not_a_page_is_one_line(talk, line):
    async def status():
        async with serve(talk, "127.0.0.1", 0) as peer:
            await HeadPage(f"http://127.0.0.1:{peer.sockets[0].getsockname()[1]}").status()

    with pytest.raises(sr.PortError, match=line):
        asyncio.run(status())


def test_a_head_that_is_not_there_is_one_line_that_says_how_to_start_one():
    failed, text = call("status", HeadPage("ws://127.0.0.1:1"))
    assert failed and "no head is there" in text and text.endswith("start one with sfms-robot run --view")


@pytest.mark.parametrize("url", ["127.0.0.1:8780", "ws://", "tcp://127.0.0.1:8780", "ws://127.0.0.1:port"])
def test_an_address_of_another_kind_is_refused(url, command_line):
    ended = command_line("mcp", "--url", url)
    assert ended.code == 2 and f"--url: expected ws://HOST:PORT, got {url!r}" in ended.err
