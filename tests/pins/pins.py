"""Golden files of a checkout: what users and programs rely on while the code is rearranged.

    python tests/pins/pins.py write [SECTION ...]      write tests/pins/golden/*.json from this checkout
    python tests/pins/pins.py compare CHECKOUT         motion of `run --fast` here and in another checkout

Sections: `options` (names, types and defaults of every command), `keys` (of the object that a command prints with
--json), `wire` (bytes that the contract rigs send), `figures` (`head solve`, `evaluate metrics`).
tests/pins/test_pins.py holds the project to them, test_base_install.py to the keys.

Floats differ between machines in their last digits: figures have a tolerance, and motion, which a listener feeds back
into itself, is compared between two checkouts on one machine.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import numpy as np

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
GOLDEN = HERE / "golden"
TESTS = (HERE.parent, HERE.parent / "servo", HERE.parent / "servo" / "contract")
TOLERANCE = 1e-4
SECTIONS = ("options", "keys", "wire", "figures")
HEADS, LISTENERS, SEEDS, SECONDS = ("face28", "reachy_mini"), ("sfms-small", "arig-small"), (0, 1, 2, 3), 20
# A mapping with more keys, all of one shape, is keyed by names (joints, channels): written as "*". A servo has 13
# values.
MANY, MANY_VALUES = 12, 20

# Commands that end within seconds on emulated servos. {tmp} is a folder of its own; earlier lines write what later
# ones read. Commands that train or score for minutes are left out: every command fails the same way.
COMMANDS = (
    "run --fast --duration 2 --record {tmp}/run",
    "run --dry-run",
    "demo --fast --duration 2 --no-view --out {tmp}/demo",
    "replay {tmp}/run",
    "replay {tmp}/run --port sim --fast",
    "doctor --head face28 --port sim",
    "head list",
    "head check face28",
    "head show face28",
    "head pose face28 yaw=0.1 --fast",
    "head solve reachy_mini --poses {tmp}/poses.csv --residual",
    "listener list",
    "output list",
    "speaker list",
    "port list",
    "servo scan --port sim --ids 1-5",
    "servo ping 1 --port sim",
    "servo read 1 present_position --port sim",
    "servo write 1 led 1 --yes --port sim",
    "servo move 1 --by 10 --port sim",
    "servo dump {tmp}/servos.yaml --port sim --ids 1",
    "servo restore {tmp}/servos.yaml --yes --port sim",
    "servo set-id 1 99 --in-chain --yes --port sim",
    "servo set-baud 1 1000000 --yes --port sim",
    "servo reboot 1 --yes --port sim",
    "servo factory-reset 1 --yes --port sim",
    "servo monitor 1 --samples 1 --port sim",
    "servo maps",
    "data compose --data {tmp}/ami --out {tmp}/dyads --minutes 1",
    "data check {tmp}/dyads",
    "evaluate metrics --truth {tmp}/truth.npy --prediction {tmp}/prediction.npy --speaker {tmp}/speaker.npy",
    "evaluate fidelity --head reachy_mini",
)


def printed(words: str, checkout: Path = ROOT) -> Any:
    """Return the object that `sfms-robot WORDS --json` of a checkout prints as its last line. Blocks."""
    code = "from sfms_robot.cli.main import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code, *words.split(), "--json"],
        capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL, cwd=checkout,
        env={**os.environ, "PYTHONPATH": str(checkout)},
    )  # fmt: skip
    if not done.stdout:
        raise SystemExit(f"sfms-robot {words}: exit {done.returncode}, nothing printed: {done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])


def write_inputs(folder: Path) -> None:
    """Write the files that `COMMANDS` read, the same at every call."""
    from ami_tables import write_tables

    drawn = np.random.default_rng(5)
    for name in ("truth", "prediction", "speaker"):
        walk = drawn.normal(0, 0.02, (8, 200, 58)).cumsum(1) + 0.3
        np.save(folder / f"{name}.npy", np.clip(walk, 0, 1).astype(np.float32))
    limits = np.array([0.01, 0.01, 0.01, 0.3, 0.3, 0.6])
    with (folder / "poses.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad"])
        rows.writerows((drawn.uniform(-1, 1, (20, 6)) * limits).round(4))
    tables = folder / "ami" / "ami_listener_annotations"
    tables.mkdir(parents=True)
    write_tables(tables, meetings=("ES2002a", "ES2003a", "ES2004a"))


def key_paths(value: Any, at: str = "") -> set[str]:
    """Return the keys of a JSON value: `report.tick.target_hz`, `rows[].name` for elements of lists."""
    if isinstance(value, list):
        return {path for each in value for path in key_paths(each, f"{at}[]")}
    if not isinstance(value, dict):
        return {at}
    below = {name: key_paths(each) for name, each in value.items()}
    alike = len({frozenset(paths) for paths in below.values()}) == 1
    values = all(paths == {""} for paths in below.values())
    if alike and len(below) > (MANY_VALUES if values else MANY):
        below = {"*": next(iter(below.values()))}
    return {f"{at}.{name}{path}" for name, paths in below.items() for path in paths}


def keys(ask: Callable[[str], Any] = printed) -> dict[str, list[str]]:
    """Run every command of `COMMANDS` by `ask`, and return the keys of each printed object. Takes minutes."""
    with tempfile.TemporaryDirectory() as tmp:
        folder = Path(tmp)
        write_inputs(folder)
        told = {words: ask(words.format(tmp=folder)) for words in COMMANDS}
    return {words: sorted(path.lstrip(".") for path in key_paths(each)) for words, each in told.items()}


def figures() -> dict[str, Any]:
    """Return figures of commands that compute without chance: they are the same on every machine to `TOLERANCE`."""
    wanted = [words for words in COMMANDS if words.startswith(("head solve", "evaluate metrics"))]
    with tempfile.TemporaryDirectory() as tmp:
        folder = Path(tmp)
        write_inputs(folder)
        return {words: printed(words.format(tmp=folder)) for words in wanted}


def options() -> dict[str, dict[str, str]]:
    """Return every option and argument of every command: its flags, type or choices, and default."""
    import typer

    from sfms_robot.cli.main import app

    def leaves(command: Any, words: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
        for name, inner in getattr(command, "commands", {}).items():
            yield from leaves(inner, (*words, name))
        if not hasattr(command, "commands"):
            yield " ".join(words), command

    def kind(annotation: Any) -> str:
        return "|".join(get_args(annotation)) if get_origin(annotation) is Literal else annotation.__name__

    return {
        words: {
            ", ".join([*each.opts, *each.secondary_opts]): " ".join(
                [
                    kind(each.type_descriptor.annotation),
                    "required" if each.required else f"= {getattr(each.default, 'value', each.default)}",
                ]
            )
            for each in command.params
        }
        for words, command in leaves(typer.main.get_command(app))
    }


def wire() -> dict[str, dict[str, Any]]:
    """Return, by family, the digest and count of bytes that its contract rig sends in one scripted session."""
    import families
    import rig

    found = {}
    for name in families.FAMILIES:
        with rig.emulated(name) as emulated:
            emulated.hold()
            emulated.ticks([0.1] * len(emulated.ids), 25)
            emulated.bus.release(emulated.bus.joints[:1])
            emulated.polls(5)
            emulated.bus.stop("release")
            sent = b"".join(emulated.sent)
        found[name] = {"sha256": hashlib.sha256(sent).hexdigest(), "bytes": len(sent)}
    return found


def motion(checkout: Path, head: str, listener: str, seed: int, folder: Path) -> np.ndarray:
    """Run a head of a checkout in virtual time, and return its goals [rad] (ticks, joints) from the recording."""
    from mcap.reader import make_reader

    printed(
        f"run --fast --head {head} --listener {listener} --seed {seed} --duration {SECONDS} --record {folder}", checkout
    )
    with (folder / "run.mcap").open("rb") as file:
        messages = [json.loads(message.data) for _, _, message in make_reader(file).iter_messages(["/joints"])]
    return np.array([[joint["goal_rad"] for joint in each["joints"].values()] for each in messages])


def compare(other: Path) -> int:
    """Print the largest difference of goals between two checkouts for every head, listener and seed; 1 if any is."""
    worst = 0.0
    for head in HEADS:
        for listener in LISTENERS:
            for seed in SEEDS:
                with tempfile.TemporaryDirectory() as tmp:
                    here, there = (
                        motion(checkout, head, listener, seed, Path(tmp) / str(number))
                        for number, checkout in enumerate((ROOT, other))
                    )
                same = here.shape == there.shape
                apart = float(np.abs(here - there).max()) if same else np.inf
                sys.stdout.write(f"{head} {listener} seed {seed}: {apart:.6f} rad apart, {here.shape} {there.shape}\n")
                worst = max(worst, apart)
    return int(worst > TOLERANCE)


def golden(section: str) -> Any:
    """Return what is committed of a section."""
    return json.loads((GOLDEN / f"{section}.json").read_text(encoding="utf-8"))


def main() -> int:
    """Write golden files, or compare two checkouts; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("write").add_argument("sections", nargs="*", default=list(SECTIONS))
    commands.add_parser("compare").add_argument("checkout", type=Path)
    given = parser.parse_args()
    if given.command == "compare":
        return compare(given.checkout.resolve())
    GOLDEN.mkdir(exist_ok=True)
    for section in given.sections:
        text = json.dumps(globals()[section](), indent=1, sort_keys=True)
        (GOLDEN / f"{section}.json").write_text(text + "\n", encoding="utf-8")
    return 0


sys.path[:0] = [str(ROOT), *map(str, TESTS)]
if __name__ == "__main__":
    sys.exit(main())
