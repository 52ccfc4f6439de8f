"""Gradients of one step: of a batch at once, or piece by piece, here and in other processes."""

from __future__ import annotations

import hashlib
from contextlib import nullcontext
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from sfms_robot.errors import ConfigError
from sfms_robot.lab.learning import resume
from sfms_robot.lab.learning.job import Job, LossOf, Run
from sfms_robot.lab.learning.process_group import ProcessGroup


def pieces_of(job: Job, run: Run, file: Path) -> int:
    """Into how many pieces every batch is cut: as the checkpoint in `file` says on resuming, else as the run asks.

    Raises ConfigError where the processes cannot share them, or where they cannot share the batch.
    """
    size, batch = run.group.size, job.phase.batch
    begun = resume.pieces(file) if run.resume else None
    pieces = size * (run.accumulate or 1) if begun is None or run.accumulate else begun
    if begun is not None and pieces != begun:
        raise ConfigError(f"{file}: was begun with {begun} pieces a step, --accumulate {run.accumulate} makes {pieces}")
    if pieces % size:
        shares = ", ".join(str(count) for count in range(1, pieces + 1) if pieces % count == 0)
        raise ConfigError(f"{file}: a step has {pieces} pieces; {size} processes cannot share them ({shares} can)")
    if batch % pieces:
        raise ConfigError(f"{job.name}: a batch of {batch} cannot be cut into {pieces} pieces (processes x accumulate)")
    return pieces


class Gradients:
    """What fills the gradients of a job's parameters, step by step; alike in all processes of the group."""

    def __init__(self, job: Job, group: ProcessGroup, pieces: int, file: Path) -> None:
        self.job, self.group, self.file = job, group, file
        self._pieces, self._samples = pieces, job.phase.batch // pieces
        self._half = job.phase.precision == "bf16" and multiplies_bf16(job.device)
        loss: nn.Module = _Loss(job.model, job.loss_of)
        if group.size > 1:  # not every part of a model learns in every phase and step
            with group.talking():
                loss = DistributedDataParallel(loss, find_unused_parameters=True)
        self._loss = loss

    def of(self, step: int, generator: torch.Generator) -> float:
        """The loss of this process' pieces, after its gradients: of all processes, for all. Raises GroupError."""
        if self._pieces == 1:
            return self._piece(step, generator, 1)
        mine = range(self.group.rank, self._pieces, self.group.size)
        total = 0.0
        for piece in mine:
            seed = _seed(self.job.seed, step, piece)
            torch.manual_seed(seed)  # of dropout
            quiet = isinstance(self._loss, DistributedDataParallel) and piece != mine[-1]
            with self._loss.no_sync() if quiet else nullcontext():  # type: ignore[operator]
                total += self._piece(step, torch.Generator().manual_seed(seed), len(mine))
        return total

    def _piece(self, step: int, generator: torch.Generator, share: int) -> float:
        with torch.autocast(self.job.device.type, torch.bfloat16, enabled=self._half):
            loss: Tensor = self._loss(step, generator, self._samples)
        with self.group.talking():
            (loss / share).backward()  # type: ignore[no-untyped-call]
        return loss.item() / share


class _Loss(nn.Module):
    """A job's loss as a module, which is what gradients are shared of."""

    def __init__(self, model: nn.Module, loss_of: LossOf) -> None:
        super().__init__()
        self.model, self._loss_of = model, loss_of

    def forward(self, step: int, generator: torch.Generator, samples: int) -> Tensor:
        return self._loss_of(step, generator, samples)


def multiplies_bf16(device: torch.device) -> bool:
    """Whether bf16 is faster there than fp32; a processor without such instructions only pretends."""
    return device.type == "cuda" or (device.type == "cpu" and torch.cpu._is_avx512_bf16_supported())


def _seed(seed: int, step: int, piece: int) -> int:
    digest = hashlib.blake2b(f"{seed} {step} {piece}".encode(), digest_size=7)
    return int.from_bytes(digest.digest(), "big")
