"""`sfms-robot serve`, `run --listener zenoh/NAME` and fleets, in processes of their own over real zenoh on loopback."""

import json
import os
import signal
import subprocess
import sys
import time
import urllib.request
from contextlib import contextmanager
from pathlib import Path

import pytest
from ended import PROGRAM
from ros2_graph import free_endpoint

pytestmark = pytest.mark.realtime

pytest.importorskip("zenoh", reason="needs the extra [remote]")
pytest.importorskip("prometheus_client", reason="needs the extra [remote]")

ROOT = Path(__file__).parents[2]
LIMIT_S = 240
LONG = ["--duration", "1200"]  # a busy machine takes a minute to load a listener


def started(*words, **more):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, sys.path)])}
    return subprocess.Popen(
        [*PROGRAM, *map(str, words)], env=environment, text=True, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, **more,
    )  # fmt: skip


@pytest.fixture
def zenoh_files(tmp_path):
    """Configurations of a server and of a robot, at a port of their own."""
    endpoint = free_endpoint()
    queue = {"link": {"tx": {"queue": {"size": {"real_time": 16}}}}}
    quiet = {"scouting": {"multicast": {"enabled": False}}, "transport": queue}
    retry = {"period_init_ms": 250, "period_max_ms": 250, "period_increase_factor": 1}
    server, robot = tmp_path / "server.json5", tmp_path / "robot.json5"
    server.write_text(json.dumps({"mode": "router", "listen": {"endpoints": [endpoint]}, **quiet}))
    connect = {"endpoints": [endpoint], "timeout_ms": -1, "retry": retry}
    robot.write_text(json.dumps({"mode": "client", "connect": connect, **quiet}))
    return server, robot


@contextmanager
def serving(file, *words):
    """A server; gives the process once it serves, and where its metrics are."""
    process = started("serve", "--hop", "3", "--everybody", "--metrics", "0", "--zenoh", file, "--json", *words)
    lines = []
    try:
        while not any("up to" in line for line in lines):
            line = process.stderr.readline()
            assert line, "".join(lines)
            lines.append(line)
        yield process, next(line.split()[1] for line in lines if line.startswith("metrics"))
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate(timeout=LIMIT_S)


def asked(file, *words):
    """`fleet ... --json`, until it says something."""
    with started("fleet", *words, "--zenoh", file, "--json") as process:
        out, _ = process.communicate(timeout=LIMIT_S)
    return json.loads(out.splitlines()[-1]) if out else {}


def heads(file, wanted):
    """Tiles of all heads, when `wanted` holds of them."""
    end_s = time.monotonic() + LIMIT_S
    while time.monotonic() < end_s:
        tiles = {each["name"]: each for each in asked(file).get("heads", [])}
        if wanted(tiles):
            return tiles
    raise AssertionError(tiles)


def obeyed(file, wanted, *words):
    """Ask until all have answered: a busy machine takes longer than a head is waited for."""
    end_s, answers = time.monotonic() + LIMIT_S, {}
    while answers != wanted:
        assert time.monotonic() < end_s, answers
        answers = {each["name"]: each.get("done") for each in asked(file, *words).get("answers", [])}


@pytest.mark.slow
def test_two_heads_and_one_server_each_in_a_process_of_its_own(zenoh_files):
    server, robot = zenoh_files
    with serving(server) as (process, metrics):
        options = ["--head", "interbotix_wxxms", "--listener", "zenoh/sfms-small", "--zenoh", robot, *LONG, "--json"]
        runs = [started("run", *options, "--fleet", name, "--seed", index) for index, name in enumerate("ab")]
        try:
            there = heads(robot, lambda tiles: {"a", "b"} <= set(tiles))
            assert there["a"]["head"] == "interbotix_wxxms"
            obeyed(robot, {"a": "halt", "b": "halt"}, "halt")
            heads(robot, lambda tiles: all(tiles.get(name, {}).get("state") == "halted" for name in "ab"))
            obeyed(robot, {"a": "resume"}, "resume", "a")
            heads(robot, lambda tiles: tiles["a"]["state"] not in ("halted",) and tiles["b"]["state"] == "halted")
            with urllib.request.urlopen(metrics) as answer:
                told = answer.read().decode()
            assert 'sfms_heads{listener="sfms-small"' in told and "sfms_plan_delay_p99_seconds" in told
        finally:
            for run in runs:
                run.send_signal(signal.SIGTERM)
            outs = [run.communicate(timeout=LIMIT_S)[0] for run in runs]
        reports = [json.loads(out.splitlines()[-1]) for out in outs]
        for report in reports:
            assert report["exit"] == "interrupted" and report["limits"]["violations"] == 0
            assert report["listener_state"]["link"]["round_trip_ms"]["p50"] is not None
        process.send_signal(signal.SIGTERM)
        assert json.loads(process.communicate(timeout=LIMIT_S)[0].splitlines()[-1])["plans"] > 0


@pytest.mark.slow
def test_a_fleet_without_a_router_is_told_in_one_line(zenoh_files):
    _, robot = zenoh_files
    with started("fleet", "--zenoh", robot) as process:
        _, err = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 3
    (line,) = err.strip().splitlines()
    assert "no answer at" in line and "sfms-robot serve" in line
