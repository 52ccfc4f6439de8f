"""An emulated microphone: a PulseAudio server with null sinks, which PortAudio reaches through ALSA.

The monitor of a sink records the sound that is played to it. The microphone is unplugged by unloading the sink.
"""

from __future__ import annotations

import os
import select
import shutil
import signal
import subprocess
from pathlib import Path
from typing import Final

DEBIAN: Final = "pulseaudio pulseaudio-utils libasound2-plugins libportaudio2"
ALSA: Final = "pcm.!default { type pulse }\nctl.!default { type pulse }\n"
_LIMIT_S: Final = 60.0  # longest duration of one command to the server


class SoundServer:
    """A server in `folder`. Programs started with `environment` find this server and no other. Linux only.

    Every method except `play` blocks until the server has done its work, and raises CalledProcessError if it fails.
    """

    def __init__(self, folder: Path) -> None:
        self.environment = {"XDG_RUNTIME_DIR": str(folder / "run"), "HOME": str(folder / "home")}
        for place in self.environment.values():
            Path(place).mkdir(mode=0o700)
        (folder / "home" / ".asoundrc").write_text(ALSA, encoding="utf-8")

    @staticmethod
    def missing() -> str | None:
        """Return the command that installs missing programs, or None."""
        return None if all(map(shutil.which, ("pulseaudio", "pactl", "paplay"))) else f"apt-get install {DEBIAN}"

    def start(self, *sinks: str) -> None:
        """Start the server with these sinks."""
        modules = ["module-native-protocol-unix", *(f"module-null-sink sink_name={sink}" for sink in sinks)]
        self._run("pulseaudio", "-n", "--daemonize=yes", "--exit-idle-time=-1", *(f"--load={each}" for each in modules))

    def stop(self) -> None:
        """End the server, and wait until it has ended."""
        pid = int((Path(self.environment["XDG_RUNTIME_DIR"]) / "pulse" / "pid").read_text(encoding="utf-8"))
        ended = os.pidfd_open(pid)
        os.kill(pid, signal.SIGTERM)
        select.select([ended], [], [], 10.0)
        os.close(ended)

    def plug(self, sink: str) -> None:
        """Load the sink, and wait until its monitor is there."""
        self.load("module-null-sink", f"sink_name={sink}")

    def unplug(self, sink: str) -> None:
        """Unload the sink; a program that records it receives nothing more if there is no other sink."""
        modules = self._run("pactl", "list", "short", "modules").splitlines()
        (module,) = [line.split()[0] for line in modules if f"sink_name={sink}" in line]
        self._run("pactl", "unload-module", module)

    def load(self, module: str, *settings: str) -> None:
        """Load a module of the server."""
        self._run("pactl", "load-module", module, *settings)

    def play(self, sink: str, file: Path | str) -> subprocess.Popen[bytes]:
        """Start a program that plays a sound file; the caller ends it."""
        words = ["paplay", f"--device={sink}", str(file)]
        return subprocess.Popen(words, env=self._environment(), stderr=subprocess.DEVNULL)

    def _environment(self) -> dict[str, str]:
        return {**os.environ, **self.environment}

    def _run(self, *words: str) -> str:
        done = subprocess.run(
            words, env=self._environment(), capture_output=True, text=True, check=True, timeout=_LIMIT_S
        )
        return done.stdout
