"""Checkpoints of a training run: everything the next step depends on, in one safetensors file and nothing pickled.

`checkpoint-NAME.safetensors` holds tensors `model.*`, `optimizer.I.J.*` (optimizer I, its parameter J), `random.*`
(states of the run's own generator and of torch's) and `best.*` (weights of the best held-out loss); its metadata hold
the position and the identity of the job as JSON.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from sfms_robot.errors import ConfigError, ModelError
from sfms_robot.lab.learning.job import Job, Position

Weights = dict[str, Tensor]


def checkpoint_file(out: Path, name: str) -> Path:
    """Where a job of this name keeps its checkpoint."""
    return out / f"checkpoint-{name}.safetensors"


def weights_of(job: Job) -> Weights:
    """A copy of the model's state, on the CPU."""
    return {name: value.detach().cpu().clone() for name, value in job.model.state_dict().items()}


def digest_of(module: nn.Module) -> str:
    """Return a digest of the weights, for the identity of a job that builds on them."""
    digest = hashlib.blake2b(digest_size=8)
    for name, value in sorted(module.state_dict().items()):
        digest.update(name.encode())
        digest.update(value.detach().cpu().contiguous().numpy().data)
    return digest.hexdigest()


def save(file: Path, job: Job, position: Position, generator: torch.Generator, best: Weights | None) -> None:
    """Write a checkpoint, replacing `file` in one move: a crash leaves the old one. Raises ConfigError."""
    tensors = {f"model.{name}": value for name, value in weights_of(job).items()}
    tensors |= {f"best.{name}": value for name, value in (best or {}).items()}
    for index, one in enumerate(job.optimizers):
        for parameter, state in one.state_dict()["state"].items():
            for key, value in state.items():
                tensors[f"optimizer.{index}.{parameter}.{key}"] = value.detach().cpu().clone()
    tensors |= {"random.data": generator.get_state(), "random.torch": torch.get_rng_state()}
    if job.device.type == "cuda":
        tensors["random.cuda"] = torch.cuda.get_rng_state(job.device)
    metadata = {"position": json.dumps(asdict(position)), "identity": json.dumps(job.identity)}
    part = file.with_suffix(".part")
    try:
        save_file(tensors, part, metadata)
        part.chmod(0o644)  # safetensors leaves it readable by its owner alone
        with part.open("rb") as written:
            os.fsync(written.fileno())
        part.replace(file)
    except (SafetensorError, OSError) as error:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        raise ConfigError(f"{file}: cannot be written: {error}") from error


def load(file: Path, job: Job, generator: torch.Generator) -> tuple[Position, Weights | None]:
    """Put model, optimizers and all random states where `file` left them.

    Raises:
        ConfigError: there is no checkpoint, or it is of another job; names the first key that differs.
        ModelError: the file is corrupt or of another version of the model's code.
    """
    if not file.is_file():
        raise ConfigError(f"{file}: no checkpoint to resume from; leave out --resume to start")
    metadata, tensors = _read(file)
    try:
        position, identity = Position(**json.loads(metadata["position"])), json.loads(metadata["identity"])
        _same(file, identity, json.loads(json.dumps(job.identity)))
        job.model.load_state_dict(_under(tensors, "model."))
        for index, one in enumerate(job.optimizers):
            one.load_state_dict(_optimizer_state(one, _under(tensors, f"optimizer.{index}.")))
        generator.set_state(tensors["random.data"])
        torch.set_rng_state(tensors["random.torch"])
        if job.device.type == "cuda" and "random.cuda" in tensors:
            torch.cuda.set_rng_state(tensors["random.cuda"], job.device)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        first = str(error).splitlines()[0]
        raise ModelError(f"{file}: does not fit this version of the model: {first}") from error
    return position, _under(tensors, "best.") or None


def peek(file: Path) -> Position | None:
    """Return the step of the checkpoint in `file`; None where there is no readable one."""
    try:
        with safe_open(file, framework="pt") as opened:
            return Position(**json.loads((opened.metadata() or {})["position"]))
    except (SafetensorError, OSError, KeyError, TypeError, ValueError):
        return None


def pieces(file: Path) -> int | None:
    """Into how many pieces the batches of the checkpoint in `file` are cut; None where it cannot be read."""
    try:
        with safe_open(file, framework="pt") as opened:
            return int(json.loads((opened.metadata() or {})["identity"]).get("pieces", 1))
    except (SafetensorError, OSError, KeyError, TypeError, ValueError):
        return None


def _read(file: Path) -> tuple[Mapping[str, str], Weights]:
    try:
        with safe_open(file, framework="pt") as opened:
            return opened.metadata() or {}, {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise ModelError(f"{file}: not a readable checkpoint: {error}") from error


def _under(tensors: Weights, prefix: str) -> Weights:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


def _optimizer_state(one: torch.optim.Optimizer, tensors: Weights) -> dict[str, Any]:
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        parameter, key = name.split(".")
        state.setdefault(int(parameter), {})[key] = value
    return {"state": state, "param_groups": one.state_dict()["param_groups"]}


def _same(file: Path, theirs: object, ours: object) -> None:
    """Raises ConfigError naming the first key whose value differs."""
    then, now = dict(_flat(theirs)), dict(_flat(ours))
    for key in [*now, *then]:
        if then.get(key, "not given") != now.get(key, "not given"):
            was, is_now = (values.get(key, "not given") for values in (then, now))
            raise ConfigError(
                f"{file}: belongs to another run: {key} = {was!r} there, {is_now!r} now; "
                "resume with the same, or leave out --resume"
            )


def _flat(value: object, key: str = "") -> Iterator[tuple[str, object]]:
    if isinstance(value, dict) and value:
        for name, inner in value.items():
            yield from _flat(inner, f"{key}.{name}" if key else name)
    else:
        yield key, value
