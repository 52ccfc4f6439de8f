"""One process of a training: what `torchrun` starts in the tests, with the losses of every step in OUT/losses.json."""

import json
import os
import signal
import sys
from pathlib import Path

import torch
from tiny_arig_training import settings

from sfms_robot.lab.learning.arig.trainer import train_arig
from sfms_robot.lab.learning.job import Run, joined


def main() -> None:
    given = json.loads(sys.argv[1])
    out = Path(given["out"])
    losses: list[float] = []

    def watch(report) -> None:
        losses.append(report.loss)
        if report.position.step == given.get("dies_at") and group.rank == 1 and not group.restarts:
            os.kill(os.getpid(), signal.SIGKILL)

    with joined(torch.device("cpu")) as group:
        resume = given.get("resume", False) or (group.restarts > 0)
        scratch = Path(given["scratch"]) if "scratch" in given else None
        run = Run(
            resume=resume, device=torch.device("cpu"), watches=(watch,), group=group,
            accumulate=given.get("accumulate"), scratch=scratch,
        )  # fmt: skip
        chosen = settings(steps=given["steps"], batch=8, evaluate_every=4, checkpoint_every=given.get("every", 500))
        figures = train_arig(chosen, Path(given["data"]), out, run)
        if group.first:
            (out / "losses.json").write_text(json.dumps({"losses": losses, "held_out": figures["held_out"],
                                                         "resumed_at": figures["resumed_at"]}))  # fmt: skip


if __name__ == "__main__":
    main()
