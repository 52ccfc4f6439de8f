"""A run that is short of descriptors, by its clients or by anything else, goes on and prints its report."""

import os
import signal
import socket

import pytest
from drill_rig import HEAD, listening, more_said, run

resource = pytest.importorskip("resource")
pytestmark = pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="no /proc here")
LIMIT_S = 10.0
WORDS = ("--audio", "none", "--status", "0")


def test_at_the_limit_of_descriptors_a_run_goes_on_and_prints_its_report(device, chain, tmp_path):
    log = tmp_path / "log"
    with log.open("w") as stderr, run(HEAD, device, *WORDS, stderr=stderr) as running:
        listening(running, chain)
        running.until(lambda: "status: http" in log.read_text())
        url = log.read_text().partition("status: ")[2].split()[0]
        taken = {int(name) for name in os.listdir(f"/proc/{running.pid}/fd")}
        least = min(set(range(len(taken) + 1)) - taken)
        resource.prlimit(running.pid, resource.RLIMIT_NOFILE, (least, least))
        with socket.create_connection(("127.0.0.1", int(url.split(":")[2][:-1])), LIMIT_S) as client:
            client.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")  # there is no descriptor for its answer
            more_said(running, chain)
        running.signal(signal.SIGTERM)
        code, out, _ = running.ended()
    assert code == 130 and f"{HEAD} listened for" in out
    assert "Traceback" not in log.read_text()
