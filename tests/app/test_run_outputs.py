"""Runs with outputs, and without servos: what a client and a receiver see, refusals, a peer that is lost."""

import json
import socket
import threading
import time
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from free_ports import free_tcp_port, free_udp_port
from pythonosc.osc_packet import OscPacket
from websockets.sync.client import connect

from sfms_robot.app.listen.knobs import RunControls
from sfms_robot.app.options import RunOptions
from sfms_robot.app.replay.run_file import read_recording
from sfms_robot.app.session import run
from sfms_robot.config import load_head
from sfms_robot.errors import ConfigError
from sfms_robot.frames import BLENDSHAPES
from sfms_robot.ports import Observer

NONE = RunOptions(head="none", duration_s=2.0, fast=True, seed=3)
LIVE = RunOptions(head="none", audio="none", duration_s=4.0)


def test_a_run_without_servos_is_a_run_with_no_joints(tmp_path):
    report = run(replace(NONE, record=tmp_path))
    assert read_recording(tmp_path).joints == () and len(read_recording(tmp_path).motion) == report["ticks"]
    assert (report["exit"], report["frames"], report["tick"]["target_hz"]) == ("done", 50, 50)
    assert report["joints"] == {} == report["wire"] and report["outputs"] == []
    assert report["limits"]["violations"] == 0 and "listening" in report["states"]["seconds"]


def test_without_servos_no_channel_of_the_face_is_left_out():
    class Watch(Observer):
        moved = np.zeros(58)

        def tick(self, seen):
            self.moved = np.maximum(self.moved, np.abs(seen.motion))

    watch = Watch()
    run(NONE, observers=[watch])
    assert (watch.moved[:3] > 0).all() and (watch.moved[6:] > 0).sum() > 5


def test_no_servos_need_no_port_and_are_known_to_runs_alone():
    with pytest.raises(ConfigError, match="^--port '/dev/ttyUSB0': --head none has no servos: leave it out$"):
        run(replace(LIVE, port="/dev/ttyUSB0"))
    with pytest.raises(ConfigError, match="head 'none' is neither"):
        load_head("none")


class Readers:
    """A plain WebSocket client, and a socket that python-osc reads, of one run."""

    def __init__(self):
        self.frames, self.faces, self.pitch = [], [], []
        self.osc = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.osc.bind(("127.0.0.1", 0))
        self.osc.settimeout(0.2)
        self.over = threading.Event()
        self.port = free_tcp_port()
        self.outputs = (f"json:{self.port}", f"vmc:{self.osc.getsockname()[1]}")
        self.threads = [threading.Thread(target=each, daemon=True) for each in (self.read_json, self.read_osc)]

    def __enter__(self):
        for thread in self.threads:
            thread.start()
        return self

    def __exit__(self, *_):
        self.over.set()
        for thread in self.threads:
            thread.join(60)
        self.osc.close()

    def read_json(self):
        while not self.over.is_set():
            try:
                with connect(f"ws://127.0.0.1:{self.port}/") as client:
                    for message in client:
                        self.frames.append(json.loads(message))
            except OSError:
                self.over.wait(0.02)

    def read_osc(self):
        while not self.over.is_set():
            try:
                packet = OscPacket(self.osc.recv(65_536))
            except TimeoutError:
                continue
            for timed in packet.messages:
                if timed.message.address == "/VMC/Ext/Blend/Apply":
                    self.faces.append(time.monotonic())
                if timed.message.params[:1] == ["Head"]:
                    self.pitch.append(2 * timed.message.params[4])  # of half the turn, about Unity's x


@pytest.mark.realtime
def test_readers_of_two_outputs_see_the_face_of_the_run_and_a_halt_makes_it_neutral(caplog):
    with Readers() as readers:
        options = replace(LIVE, outputs=readers.outputs)
        controls = RunControls(load_head("none", servos=False), options)
        motion = np.zeros(58, np.float32)
        motion[1], motion[6 + BLENDSHAPES.index("mouthSmileLeft")] = 0.3, 0.5

        class Program(Observer):
            shown = False

            def tick(self, seen):
                if not self.shown and seen.time_s > 1.0:
                    self.shown = True
                    controls.puppet.show(motion, 2.0)
                if 2.6 < seen.time_s < 3.7:
                    controls.halt.close("test")
                elif seen.time_s > 3.7 and controls.halt.causes:
                    controls.halt.resume("device")

        report = run(options, controls=controls, observers=[Program()])
    assert report["states"]["changes"][3]["state"] == "starting"  # after the halt
    assert report["exit"] == "done" and [each["state"] for each in report["outputs"]] == ["sending", "sending"]
    smiles = [each["shapes"]["mouthSmileLeft"] for each in readers.frames]
    halted = [each["shapes"]["mouthSmileLeft"] for each in readers.frames if each["state"] == "halted"]
    assert max(smiles) == pytest.approx(0.5, abs=1e-3) and halted[0] > 0.3 and halted[-1] < 0.02
    assert np.abs(np.diff(smiles)).max() < 0.1
    assert max(each["pose"]["pitch"] for each in readers.frames) == pytest.approx(0.3, abs=1e-3)
    assert max(readers.pitch) == pytest.approx(2 * np.sin(0.075), abs=1e-3)
    rates = [each["frames"] for each in report["outputs"]]
    assert len(readers.faces) == pytest.approx(rates[1], abs=3) and len(readers.frames) >= 0.9 * rates[0]
    assert not [each for each in caplog.records if each.levelname == "WARNING" and "output" in each.name]


@pytest.mark.realtime
@pytest.mark.slow
def test_a_receiver_that_is_away_is_said_once_and_named_by_the_state(caplog):
    report = run(replace(LIVE, duration_s=3.0, outputs=(f"vmc:{free_udp_port()}",)))
    (sent,) = report["outputs"]
    assert (report["exit"], sent["state"], sent["losses"]) == ("done", "lost", 1)
    assert [f"vmc:{sent['peer']}"] in [each["why"] for each in report["states"]["changes"]]
    said = Counter(each.levelname for each in caplog.records if sent["peer"] in each.getMessage())
    assert said["WARNING"] == 1


def test_a_run_without_servos_prints_its_report(command_line):
    done = command_line("run", "--head", "none", "--fast", "--duration", "1", "--audio", "none")
    assert done.code == 0 and "none listened for 1 s (done)" in done.out and "bus:" not in done.out, done.err
