"""`sfms-robot fleet` beside a router: a page that says where it is, and options where they belong."""

import json
import signal
import subprocess
from contextlib import closing
from urllib.request import urlopen

import pytest
from ended import PROGRAM
from ros2_graph import free_endpoint

from sfms_robot.app.fleet import FleetControls, FleetHead, fleet_key, open_fleet
from sfms_robot.app.listen.knobs import RunControls
from sfms_robot.app.options import RunOptions
from sfms_robot.config import load_head
from sfms_robot.errors import ConfigError
from sfms_robot.network import Router, close_session, serve_session, session_config

ALONE = {"scouting": {"multicast": {"enabled": False}}}


@pytest.mark.parametrize("ending", [signal.SIGTERM, signal.SIGINT])
def test_a_page_prints_its_address_as_json_and_serves_until_a_signal_ends_it(router, ending):
    words = ["fleet", "page", "--port", "0", "--zenoh", str(router.file), "--json"]
    with subprocess.Popen([*PROGRAM, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        told = json.loads(process.stdout.readline())
        with urlopen(f"{told['url']}heads") as answer:
            assert json.load(answer) == {"heads": []}
        process.send_signal(ending)
        rest, error = process.communicate(timeout=30)
    assert (process.returncode, rest, error) == (0, "", "")


def test_resume_and_end_are_refused_without_the_fleets_key_and_halt_is_not(router, tmp_path, command_line, caplog):
    mine, other = tmp_path / "mine.key", tmp_path / "other.key"
    run = RunControls(load_head("face28"), RunOptions())
    latch, interrupt, run.document = run.halt, run.interrupt, lambda: {"state": "halted"}
    head = FleetHead(FleetControls(run, "hall", fleet_key(mine)), router)
    with closing(head), open_fleet(router.file) as fleet:
        while not fleet.states():
            pass  # until it is connected
        halted = command_line("fleet", "halt", "--zenoh", router.file, "--json").told
        assert halted["answers"] == [{"name": "hall", "done": "halt"}] and latch.by is not None
        for words in (["--fleet-key", other], []):  # that of another fleet, and one that is made on first use
            ended = command_line("fleet", "resume", "hall", "--zenoh", router.file, *words)
            assert "resume: proof: expected the fleet's key (--fleet-key)" in ended.out and latch.by is not None
        for command in ("resume", "end"):
            (answer,) = fleet.command(["hall"], {"command": command})
            assert "--fleet-key" in answer["error"] and not interrupt()
        (document,) = fleet.states()
        assert document["malformed"] == 4 and [each.levelname for each in caplog.records] == ["WARNING"]
        resumed = command_line("fleet", "resume", "--zenoh", router.file, "--fleet-key", mine, "--json").told
        assert resumed["answers"] == [{"name": "hall", "done": "resume"}]
        assert latch.by is None


def test_documents_that_are_none_are_counted_and_the_first_is_logged(router, command_line, caplog):
    session = serve_session(session_config("call", router))
    for number, document in enumerate([b"\xff", b"[1]", b"1" * 5000, b'{"person": "loud"}', b'{"name": "hall"}']):
        key = f"sfms/{number}/state"
        session.declare_queryable(key, lambda query, key=key, document=document: query.reply(key, document))
    ended = command_line("fleet", "--zenoh", router.file, "--json")
    close_session(session)
    assert [each["name"] for each in ended.told["heads"]] == ["hall"] and ended.told["malformed"] == 4
    (line,) = [each.getMessage() for each in caplog.records]
    assert "sfms/" in line and "only counted" in line


@pytest.mark.slow
def test_a_fleet_without_a_router_is_told_in_one_line(tmp_path, command_line):
    pytest.importorskip("zenoh", reason="needs the extra [ros2]")
    file, connect = tmp_path / "robot.json5", {"endpoints": [free_endpoint()], "timeout_ms": -1}
    file.write_text(json.dumps({"mode": "client", "connect": connect, **ALONE}))
    ended = command_line("fleet", "--zenoh", file)
    assert ended.code == 3 and "no answer at" in ended.complaint and "sfms-robot serve" in ended.complaint


@pytest.mark.parametrize(
    ("words", "mode", "key", "endpoints"),
    [
        (["serve"], "router", "listen", ["tcp/192.0.2.1:7447"]),
        (["serve"], "router", "listen", ["tls/192.0.2.1:7447", "udp/[2001:db8::1]:7447?rel=1"]),
        (["run", "--listener", "zenoh/x"], "client", "connect", {"client": ["ws/robot.example:7447#iface=eth0"]}),
        (["run", "--fleet", "hall"], "client", "connect", ["tcp/10.0.0.1:7447"]),
        *((["fleet", *more], "client", "connect", ["tcp/10.0.0.1:1"]) for more in ([], ["halt"], ["resume"], ["page"])),
    ],
    ids=lambda each: " ".join(each) if isinstance(each, list) else None,
)
def test_a_router_beyond_loopback_without_tls_needs_to_be_asked_for(
    words, mode, key, endpoints, tmp_path, command_line
):
    file = tmp_path / "open.json5"
    file.write_text(json.dumps({"mode": mode, key: {"endpoints": endpoints}, **ALONE}))
    ended = command_line(*words, "--zenoh", file)
    wrong = list(endpoints.values())[0][-1] if isinstance(endpoints, dict) else endpoints[-1]
    assert ended.code == 2 and f"{file}: {key}.endpoints: expected loopback or TLS, got {wrong}" in ended.complaint
    assert "TLS in docs/guide/remote.md" in ended.complaint and "--insecure" in ended.complaint
    assert session_config("call", Router(file, insecure=True)) is not None


@pytest.mark.parametrize(
    ("settings", "wrong"),
    [
        ({"mode": "router", **ALONE}, "listen.endpoints"),  # a router listens on every address by default
        ({"mode": "client"}, "scouting.multicast.enabled"),
        ({"mode": "client", "connect": {"endpoints": ["tls/192.0.2.1:7447"]}}, None),
        ({"mode": "client", "connect": {"endpoints": ["tcp/localhost:1", "tcp/[::1]:1", "tcp/127.0.0.9:1"]}}, None),
        ({"mode": "peer", "listen": {"endpoints": ["quic/192.0.2.1:1"]}, **ALONE}, None),
    ],
)  # fmt: skip
def test_the_defaults_of_zenoh_count_too(settings, wrong, tmp_path):
    pytest.importorskip("zenoh", reason="needs the extra [remote]")
    file = tmp_path / "given.json5"
    file.write_text(json.dumps(settings))
    if wrong is None:
        session_config("call", Router(file))
    else:
        with pytest.raises(ConfigError, match=wrong):
            session_config("call", Router(file))
