"""What nine heads are sent in virtual time, with both listeners: one line each, to hold one version against another.

    python tests/command_streams.py > before.txt     # then change something
    python tests/command_streams.py | diff before.txt -

Not a test: the bytes are the same for one seed on one machine, and differ between machines by rounding.
"""

import json
import subprocess
import sys

HEADS = (
    "face24_maestro", "face28", "inmoov2_maestro", "inmoov2_ssc32", "interbotix_wxxms", "op3_head",
    "open_duck_mini_v2_head", "poppy_head", "reachy_mini",
)  # fmt: skip
LISTENERS = ("sfms-small", "arig-small")
SEED, SECONDS = 3, 8


def stream(head: str, listener: str) -> str:
    """`HEAD LISTENER BUS SHA256 BYTES ...` of one run."""
    command = [
        sys.executable, "-c", "from sfms_robot.cli.main import main; main()", "run", "--fast", "--json",
        "--head", head, "--listener", listener, "--seed", str(SEED), "--duration", str(SECONDS),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        return f"{head} {listener} exit {done.returncode}: {done.stderr.strip().splitlines()[-1]}"
    wire = json.loads(done.stdout.splitlines()[-1])["wire"]
    return " ".join([head, listener, *(f"{bus} {w['sha256']} {w['bytes']}" for bus, w in sorted(wire.items()))])


if __name__ == "__main__":
    for each_head in HEADS:
        for each_listener in LISTENERS:
            sys.stdout.write(stream(each_head, each_listener) + "\n")
            sys.stdout.flush()
