"""A sound server of the tests' own: PulseAudio with null sinks, which PortAudio reaches through ALSA's plugin.

What is played to a sink is what its monitor records. Unplugging is unloading the sink.
"""

import os
import select
import shutil
import signal
import subprocess
from pathlib import Path

DEBIAN = "pulseaudio pulseaudio-utils libasound2-plugins libportaudio2"
ALSA = "pcm.!default { type pulse }\nctl.!default { type pulse }\n"


class SoundServer:
    """A server in `folder`; `environment` is what programs need to find it, and no other."""

    def __init__(self, folder):
        self.environment = {"XDG_RUNTIME_DIR": str(folder / "run"), "HOME": str(folder / "home")}
        for place in self.environment.values():
            Path(place).mkdir(mode=0o700)
        (folder / "home" / ".asoundrc").write_text(ALSA)

    @staticmethod
    def missing():
        """What has to be installed, or None."""
        return None if all(map(shutil.which, ("pulseaudio", "pactl", "paplay"))) else f"apt-get install {DEBIAN}"

    def start(self, *sinks):
        modules = ["module-native-protocol-unix", *(f"module-null-sink sink_name={sink}" for sink in sinks)]
        self._run("pulseaudio", "-n", "--daemonize=yes", "--exit-idle-time=-1", *(f"--load={each}" for each in modules))

    def stop(self):
        """End it, and wait until it has ended."""
        pid = int((Path(self.environment["XDG_RUNTIME_DIR"]) / "pulse" / "pid").read_text())
        ended = os.pidfd_open(pid)
        os.kill(pid, signal.SIGTERM)
        select.select([ended], [], [], 10.0)
        os.close(ended)

    def plug(self, sink):
        """Load the sink, and wait until its monitor is there."""
        self.load("module-null-sink", f"sink_name={sink}")

    def unplug(self, sink):
        """Unload the sink: whoever records it gets nothing more, where there is no other one."""
        modules = self._run("pactl", "list", "short", "modules").splitlines()
        (module,) = [line.split()[0] for line in modules if f"sink_name={sink}" in line]
        self._run("pactl", "unload-module", module)

    def load(self, module, *settings):
        self._run("pactl", "load-module", module, *settings)

    def play(self, sink, file):
        """A program that plays a sound file; to be ended by the caller."""
        return subprocess.Popen(["paplay", f"--device={sink}", str(file)], env=self._environment())

    def _environment(self):
        return {**os.environ, **self.environment}

    def _run(self, *words):
        done = subprocess.run(words, env=self._environment(), capture_output=True, text=True, check=True, timeout=60)
        return done.stdout
