"""The training loop of all models: `fit` runs a `Job` to its end and can be interrupted and resumed.

One step: draw data, loss, gradients, clip, AdamW with a warmed-up cosine rate. Between steps: the held-out loss with
early stop, and checkpoints from which a run continues bit for bit (on a CPU). How to write a trainer: `learning.job`.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Generator, Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from sfms_robot import config
from sfms_robot.errors import ConfigError, GroupError, ModelError, first_line
from sfms_robot.lab.learning.job import ALONE, Job, LossOf, Position, ProcessGroup, Report, Run, TrainingOutcome

SMOOTHING = 0.98  # exponential, of the loss that is shown
READ_EVERY = 10  # steps on a GPU whose losses are read together, since reading makes the host wait

log = logging.getLogger(__name__)


def optimizer(parameters: Iterable[nn.Parameter], rate: float, decay: float) -> torch.optim.Optimizer:
    """Return AdamW with the paper's betas (V-A), in one kernel on a GPU."""
    learned = list(parameters)
    fused = learned[0].is_cuda or None
    return torch.optim.AdamW(learned, lr=rate, betas=(0.9, 0.98), weight_decay=decay, fused=fused)


def fit(job: Job, out: Path, run: Run = ALONE, clock: Callable[[], float] = time.monotonic) -> TrainingOutcome:
    """Run `job` to its last step or until its patience ends; the model then holds its best weights.

    Checkpoints go to `out`/checkpoint-NAME.safetensors; `run.resume` continues from there, and a run that had finished
    only restores its weights. Ctrl-C finishes the step, writes a checkpoint and raises KeyboardInterrupt with a line
    for the user; a second one stops at once. Raises ModelError as soon as a loss or a gradient is not finite (the last
    checkpoint stays), and if a GPU has too little memory (after writing a checkpoint of the steps made so far). On a
    GPU losses are read, and reports made, every `READ_EVERY` steps. `clock` [s] determines the times of checkpoints and
    the reported speed, but no weights.

    In a group of processes (`run.group`) all make the same steps; the first evaluates held-out data and writes files.
    There `fit` also raises GroupError if another process is gone, and ConfigError if they cannot share the batch.
    """
    file, phase = checkpoint_file(out, job.name), job.phase
    group, pieces = run.group, pieces_of(job, run, file)
    job = replace(job, identity={**job.identity, **({"pieces": pieces} if pieces > 1 else {})})
    try:
        out.mkdir(parents=True, exist_ok=True)  # fail here, hours before the folder is needed
    except OSError as error:
        raise ConfigError(f"{out}: cannot be made a folder: {error}") from error
    generator = Generator().manual_seed(job.seed)
    torch.manual_seed(job.seed)  # dropout must not depend on earlier draws
    position, best = Position(), None
    if run.resume:
        position, best = load_checkpoint(file, job, generator)
    elif group.first and (left := peek(file)) and not left[0].finished:
        log.warning("%s: was at step %d, starts again; --resume would have continued", file, left[0].step)
    began_at, rates = position.step, job.optimizers[0].param_groups[0]
    saved_s = began_s = clock()
    job.model.train()
    gradients = Gradients(job, group, pieces, file, run.read_every)
    every = phase.evaluate_every if job.held_out else 0
    made: list[Tensor] = []  # loss and norm of steps that are not read yet
    with _interruptions(patient=group.size > 1) as pressed:
        while not position.finished:
            step = position.step + len(made)
            _set_rates(job, step)
            with _enough_memory(gradients, position, made, generator, best):
                made.append(make_step(gradients, step, generator))
            looked = every > 0 and ((step + 1) % every == 0 or step + 1 == phase.steps)
            stops = looked or step + 1 == phase.steps or (step + 1) % phase.checkpoint_every == 0
            if not stops and len(made) < gradients.read_every and not (group.size == 1 and pressed()):
                continue
            found, interrupted = gradients.read(made, position.step, pressed())
            for loss, norm in found:
                position = _moved(position, loss)
                looks = looked and position.step == step + 1  # only the last of the steps that are read
                if looks:
                    position = _compared(position, group.from_first(partial(_held_out, job)))
                    best = weights_of(job) if position.worse == 0 else best
                impatient = phase.patience is not None and position.worse >= phase.patience
                position = replace(position, finished=impatient or position.step >= phase.steps)
                now_s = clock()
                report = Report(
                    name=job.name, steps=phase.steps, position=position, loss=loss, gradient_norm=norm,
                    learning_rate=rates["initial_lr"] * schedule(position.step - 1, phase), looked=looks,
                    frames_per_s=job.frames_per_step * (position.step - began_at) / max(now_s - began_s, 1e-9),
                )  # fmt: skip
                for watch in run.watches:
                    watch(report)
            made.clear()
            interrupted |= group.size == 1 and pressed()
            due = position.step % phase.checkpoint_every == 0 or now_s - saved_s >= 60 * phase.checkpoint_minutes
            if group.first and (interrupted or position.finished or due):
                save_checkpoint(file, job, position, generator, best)
                saved_s = now_s
            if interrupted:
                at = f"{job.name}: interrupted after step {position.step} of {phase.steps}, saved in {file}"
                raise KeyboardInterrupt(f"{at}; the same command with --resume continues")
    return _ended(job, position, best, began_at if run.resume else None)


def _ended(job: Job, position: Position, best: Weights | None, resumed_at: int | None) -> TrainingOutcome:
    """Put the best weights into the model, and return the outcome."""
    if best is not None:
        job.model.load_state_dict(best)
    return TrainingOutcome(
        loss=math.nan if position.loss is None else position.loss,
        held_out=position.best,
        steps=position.step,
        best_step=position.step if best is None else position.best_step,
        stopped="steps" if position.step == job.phase.steps else "patience",
        resumed_at=resumed_at,
    )


def schedule(step: int, phase: config.Phase) -> float:
    """Return the share of the learning rate at `step`: linear warm-up, cosine to zero (V-A; the warm-up is ours)."""
    warm = min(phase.warm_up_steps, max(1, phase.steps // 10))
    if step < warm:
        return (step + 1) / warm
    return 0.5 * (1 + math.cos(math.pi * (step - warm) / max(1, phase.steps - warm)))


def _set_rates(job: Job, step: int) -> None:
    """Set the learning rates of `step` from the initial ones, which are kept as `initial_lr`."""
    share = schedule(step, job.phase)
    for one in job.optimizers:
        for group in one.param_groups:
            group["lr"] = group.setdefault("initial_lr", group["lr"]) * share


def make_step(gradients: Gradients, step: int, generator: Generator) -> Tensor:
    """Update the weights once; return loss and largest gradient norm (2,) of this process, on the device.

    Raises ModelError, on a CPU and before updating anything, if loss or norm is not finite; GroupError.
    """
    job = gradients.job
    job.model.zero_grad()
    with gradients.talking(step):
        loss = gradients.of(step, generator)
    norms = [_clip(one, job.phase.clip_norm) for one in job.optimizers]
    made = torch.stack([loss, torch.stack(norms).max().to(loss)])
    if gradients.read_every == 1:
        gradients.check(made.tolist(), step)
    for one in job.optimizers:
        one.step()
    return made


def _moved(position: Position, loss: float) -> Position:
    """Return the position one step on, with the smoothed loss."""
    smooth = loss if position.loss is None else SMOOTHING * position.loss + (1 - SMOOTHING) * loss
    return replace(position, step=position.step + 1, loss=smooth)


@contextmanager
def _enough_memory(
    gradients: Gradients,
    position: Position,
    made: Sequence[Tensor],
    generator: Generator,
    best: Weights | None,
) -> Iterator[None]:
    """Run a step; if the GPU has too little memory, write a checkpoint of the steps `made`, and raise ModelError."""
    try:
        yield
    except torch.OutOfMemoryError as error:
        job, file = gradients.job, gradients.file
        job.model.zero_grad()
        for values in made:
            position = _moved(position, values.tolist()[0])
        step = position.step
        if step and gradients.group.first:
            save_checkpoint(file, job, position, generator, best)
        few = f"too little memory on the GPU for a batch of {job.phase.batch} at step {step}"
        raise ModelError(f"{job.name}: {few}: begin with --accumulate 2 or more ({_kept(file)})") from error


def _kept(file: Path) -> str:
    left = peek(file)
    return f"{file} holds step {left[0].step}" if left else "there is no checkpoint yet"


def _clip(one: torch.optim.Optimizer, norm: float) -> Tensor:
    parameters = [p for group in one.param_groups for p in group["params"] if p.grad is not None]
    return nn.utils.clip_grad_norm_(parameters, norm) if parameters else one.param_groups[0]["params"][0].new_zeros(())


def _held_out(job: Job) -> float:
    """Return the held-out loss; random states and the model's mode are kept. Raises ModelError if it is not finite."""
    assert job.held_out is not None
    job.model.eval()
    devices = [job.device] if job.device.type == "cuda" else []
    with torch.random.fork_rng(devices), torch.no_grad():
        value = float(job.held_out())
    job.model.train()
    if not math.isfinite(value):
        raise ModelError(f"{job.name}: held-out loss {value:g}: not finite")
    return value


def _compared(position: Position, held_out: float) -> Position:
    if position.best is None or held_out < position.best:
        return replace(position, held_out=held_out, best=held_out, best_step=position.step, worse=0)
    return replace(position, held_out=held_out, worse=position.worse + 1)


@contextmanager
def _interruptions(patient: bool = False) -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether Ctrl-C was pressed; in the context, the first one only sets a flag.

    `patient`: later ones too, since torchrun passes on those of the terminal. Signals reach the main thread only.
    """
    pressed = list[bool]()  # not an Event: a second signal may come while the handler of the first holds its lock

    def press(*_: object) -> None:
        pressed.append(True)
        if not patient:
            signal.signal(signal.SIGINT, before)  # the second one has its usual effect

    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    before = signal.getsignal(signal.SIGINT) or signal.default_int_handler
    signal.signal(signal.SIGINT, press)
    try:
        yield lambda: bool(pressed)
    finally:
        signal.signal(signal.SIGINT, before)


# --- Gradients of one step: of a batch at once, or piece by piece, here and in other processes --------------------


def pieces_of(job: Job, run: Run, file: Path) -> int:
    """Return the number of pieces of every batch: on resuming that of the checkpoint `file`, else set by the run.

    Raises ConfigError if the processes cannot share the pieces, or the batch cannot be cut into them.
    """
    size, batch = run.group.size, job.phase.batch
    pieces = size * (run.accumulate or 1)
    if run.resume and (left := peek(file)):
        pieces = pieces if run.accumulate else left[1]
        if pieces != left[1]:
            raise ConfigError(
                f"{file}: was begun with {left[1]} pieces a step, --accumulate {run.accumulate} makes {pieces}"
            )
    if pieces % size:
        shares = ", ".join(str(count) for count in range(1, pieces + 1) if pieces % count == 0)
        raise ConfigError(f"{file}: a step has {pieces} pieces; {size} processes cannot share them ({shares} can)")
    if batch % pieces:
        raise ConfigError(f"{job.name}: a batch of {batch} cannot be cut into {pieces} pieces (processes x accumulate)")
    return pieces


class Gradients:
    """Gradients of a job's parameters, filled step by step; the same in all processes of the group."""

    def __init__(self, job: Job, group: ProcessGroup, pieces: int, file: Path, read_every: int | None = None) -> None:
        self.job, self.group, self.file = job, group, file
        self._pieces, self._samples = pieces, job.phase.batch // pieces
        self.read_every = read_every or (1 if job.device.type == "cpu" else READ_EVERY)
        # A processor without instructions for bf16 emulates it, which is slower than fp32.
        fast = job.device.type == "cuda" or (job.device.type == "cpu" and torch.cpu._is_avx512_bf16_supported())
        self._half = job.phase.precision == "bf16" and fast
        loss: nn.Module = _Loss(job.model, job.loss_of)
        if group.size > 1:  # not every part of a model learns in every phase and step
            with group.talking():
                loss = DistributedDataParallel(loss, find_unused_parameters=True)
        self._loss = loss

    def of(self, step: int, generator: Generator) -> Tensor:
        """Return the loss of this process' pieces; set the gradients of all processes. Raises GroupError."""
        if self._pieces == 1:
            return self._piece(step, generator, 1)
        mine = range(self.group.rank, self._pieces, self.group.size)
        total = torch.zeros((), dtype=torch.float64, device=self.job.device)
        for piece in mine:
            digest = hashlib.blake2b(f"{self.job.seed} {step} {piece}".encode(), digest_size=7)
            seed = int.from_bytes(digest.digest(), "big")
            torch.manual_seed(seed)  # for dropout
            quiet = isinstance(self._loss, DistributedDataParallel) and piece != mine[-1]
            with self._loss.no_sync() if quiet else nullcontext():  # type: ignore[operator]
                total += self._piece(step, Generator().manual_seed(seed), len(mine))
        return total

    @contextmanager
    def talking(self, step: int) -> Iterator[None]:
        """Run a part of a step that needs the other processes. Raises GroupError, which names job and checkpoint."""
        try:
            yield
        except GroupError as error:
            where = f"at step {step} ({_kept(self.file)}; --resume continues)"
            raise GroupError(f"{self.job.name}: {error}; {where}") from error

    def read(self, made: list[Tensor], first: int, pressed: bool) -> tuple[list[tuple[float, float]], bool]:
        """Return losses and norms of steps from `first` on, and whether Ctrl-C was pressed in any process.

        Waits for the device. Raises ModelError for a value that is not finite; GroupError.
        """
        losses, norms = torch.stack(made, dim=1).tolist()
        with self.talking(first + len(made) - 1):
            *losses, asked = self.group.mean([*losses, float(pressed)])
        found = list(zip(losses, norms, strict=True))
        for step, each in enumerate(found, first):
            self.check(each, step)
        return found, asked > 0

    def check(self, made: Sequence[float], step: int) -> None:
        """Raise ModelError if loss or norm of a step is not finite."""
        if not all(map(math.isfinite, made)):
            broken = f"loss {made[0]:g}, gradient norm {made[1]:g} at step {step}: not finite"
            raise ModelError(f"{self.job.name}: {broken} ({_kept(self.file)})")

    def _piece(self, step: int, generator: Generator, share: int) -> Tensor:
        with torch.autocast(self.job.device.type, torch.bfloat16, enabled=self._half):
            loss: Tensor = self._loss(step, generator, self._samples)
        with self.group.talking():
            (loss / share).backward()  # type: ignore[no-untyped-call]
        return loss.detach().double() / share


class _Loss(nn.Module):
    """A job's loss as a module: DistributedDataParallel shares the gradients of modules."""

    def __init__(self, model: nn.Module, loss_of: LossOf) -> None:
        super().__init__()
        self.model, self._loss_of = model, loss_of

    def forward(self, step: int, generator: Generator, samples: int) -> Tensor:
        return self._loss_of(step, generator, samples)


# --- Checkpoints -----------------------------------------------------------------------------------------------------
#
# `checkpoint-NAME.safetensors` holds tensors `model.*`, `optimizer.I.J.*` (optimizer I, its parameter J), `random.*`
# (states of the run's own generator and of torch's) and `best.*` (weights of the best held-out loss); its metadata hold
# the position and the identity of the job as JSON.

Weights = dict[str, Tensor]


def checkpoint_file(out: Path, name: str) -> Path:
    """Return the checkpoint file of a job of this name."""
    return out / f"checkpoint-{name}.safetensors"


def weights_of(job: Job) -> Weights:
    """Return a copy of the model's state, on the CPU."""
    return {name: value.detach().cpu().clone() for name, value in job.model.state_dict().items()}


def digest_of(module: nn.Module) -> str:
    """Return a digest of the weights, for the identity of a job that builds on them."""
    digest = hashlib.blake2b(digest_size=8)
    for name, value in sorted(module.state_dict().items()):
        digest.update(name.encode())
        digest.update(value.detach().cpu().contiguous().numpy().data)
    return digest.hexdigest()


def save_checkpoint(file: Path, job: Job, position: Position, generator: Generator, best: Weights | None) -> None:
    """Write a checkpoint (`write_whole`)."""
    tensors = {f"model.{name}": value for name, value in weights_of(job).items()}
    tensors |= {f"best.{name}": value for name, value in (best or {}).items()}
    for index, one in enumerate(job.optimizers):
        for parameter, state in one.state_dict()["state"].items():
            for key, value in state.items():
                tensors[f"optimizer.{index}.{parameter}.{key}"] = value.detach().cpu().clone()
    tensors |= {"random.data": generator.get_state(), "random.torch": torch.get_rng_state()}
    if job.device.type == "cuda":
        tensors["random.cuda"] = torch.cuda.get_rng_state(job.device)
    write_whole(file, tensors, {"position": json.dumps(asdict(position)), "identity": json.dumps(job.identity)})


def write_whole(file: Path, tensors: Weights, metadata: dict[str, str]) -> None:
    """Write a safetensors file, replacing `file` in one move: a crash leaves the old one. Raises ConfigError."""
    part = file.with_suffix(".part")
    try:
        save_file(tensors, part, metadata)
        part.chmod(0o644)  # safetensors makes it readable only by its owner
        with part.open("rb") as written:
            os.fsync(written.fileno())
        part.replace(file)
    except (SafetensorError, OSError) as error:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        raise ConfigError(f"{file}: cannot be written: {error}") from error


def load_checkpoint(file: Path, job: Job, generator: Generator) -> tuple[Position, Weights | None]:
    """Restore model, optimizers and all random states from `file`.

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
            state: dict[int, Weights] = {}
            for name, value in _under(tensors, f"optimizer.{index}.").items():
                parameter, key = name.split(".")
                state.setdefault(int(parameter), {})[key] = value
            one.load_state_dict({"state": state, "param_groups": one.state_dict()["param_groups"]})
        generator.set_state(tensors["random.data"])
        torch.set_rng_state(tensors["random.torch"])
        if job.device.type == "cuda" and "random.cuda" in tensors:
            torch.cuda.set_rng_state(tensors["random.cuda"], job.device)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ModelError(f"{file}: does not fit this version of the model: {first_line(error)}") from error
    return position, _under(tensors, "best.") or None


def peek(file: Path) -> tuple[Position, int] | None:
    """Return the position of the checkpoint in `file`, and the number of pieces of its batches.

    None if there is no readable checkpoint.
    """
    try:
        metadata, _ = _read(file, tensors=False)
        identity = json.loads(metadata["identity"])
        return Position(**json.loads(metadata["position"])), int(identity.get("pieces", 1))
    except (ModelError, KeyError, TypeError, ValueError):
        return None


def _read(file: Path, tensors: bool = True) -> tuple[Mapping[str, str], Weights]:
    try:
        with safe_open(file, framework="pt") as opened:
            names = list(opened.keys()) if tensors else []
            return opened.metadata() or {}, {name: opened.get_tensor(name) for name in names}
    except (SafetensorError, OSError) as error:
        raise ModelError(f"{file}: not a readable checkpoint: {error}") from error


def _under(tensors: Weights, prefix: str) -> Weights:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


def _same(file: Path, theirs: object, ours: object) -> None:
    """Raise ConfigError with the first key whose value differs."""
    then, now = dict(_flat(theirs)), dict(_flat(ours))
    for key in [*now, *then]:
        was, is_now = (values.get(key, "not given") for values in (then, now))
        if was != is_now:
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
