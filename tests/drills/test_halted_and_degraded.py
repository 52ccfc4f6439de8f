"""A run that is halted from outside, and one whose listener is killed, as the status server tells it."""

import json
import os
import signal
from pathlib import Path
from urllib.request import urlopen

import pytest
from drill_rig import HEAD, Command

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not os.path.isdir("/proc/self/task"), reason="no /proc here")]
RUN = ("run", "--head", HEAD, "--duration", 600)
TOLD = "status: "


class Watched(Command):
    """A run on emulated servos that serves how it is. The file that its log goes to tells where."""

    def __init__(self, log: Path, *words):
        self._log = log
        with log.open("wb") as file:
            super().__init__(*RUN, "--status", 0, "--json", *words, stderr=file.fileno())
        self.until(lambda: TOLD in log.read_text())
        (self._url,) = (line[len(TOLD) :] for line in log.read_text().splitlines() if line.startswith(TOLD))

    def document(self):
        with urlopen(self._url, timeout=10) as answer:
            return json.load(answer)

    def until_state(self, *states):
        self.until(lambda: self.document()["state"] in states)

    def listener(self) -> int:
        """Process id of the child that listens: the emulated servos are another."""
        return next(pid for pid in self.children() if "listeners.process" in Path(f"/proc/{pid}/cmdline").read_text())

    def report(self):
        self.signal(signal.SIGINT)
        ended = self.ended()
        assert ended.code == 130, self._log.read_text()
        return json.loads(ended.out.splitlines()[-1])


@pytest.fixture
def log(tmp_path):
    return tmp_path / "log"


def test_a_file_halts_a_run_until_a_signal_lets_it_go_on(log, tmp_path):
    switch = tmp_path / "halt"
    with Watched(log, "--halt-on", switch) as running:
        running.until_state("listening")
        switch.touch()
        running.until_state("halted")
        assert running.document()["why"] == [str(switch)]
        running.signal(signal.SIGUSR2)
        running.until(lambda: f"still halted: {switch}" in log.read_text())
        assert running.document()["state"] == "halted"
        switch.unlink()
        running.signal(signal.SIGUSR2)
        running.until_state("listening")
        report = running.report()
    states = [change["state"] for change in report["states"]["changes"]]
    assert states[states.index("halted") + 1] == "starting"
    assert report["limits"]["violations"] == 0


def test_a_listener_that_is_killed_is_missed_and_comes_back(log):
    with Watched(log) as running:
        running.until_state("listening")
        os.kill(running.listener(), signal.SIGKILL)
        running.until_state("degraded")
        assert running.document()["why"] == ["listener"]
        running.until_state("listening")
        document = running.document()
        running.report()
    assert document["listener_state"]["restarts"] == 1
    assert document["ticks"] > 0 and document["tick"]["target_hz"] > 0 and set(document["motion"]) >= {"nods"}
