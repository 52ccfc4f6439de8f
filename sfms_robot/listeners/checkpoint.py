"""A listener's folder: config.yaml, model.safetensors. Everything that can be wrong with it is one ModelError."""

from __future__ import annotations

from pathlib import Path

import yaml
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import nn

from sfms_robot import config
from sfms_robot.errors import ModelError

CONFIG = "config.yaml"
WEIGHTS = "model.safetensors"
LARGEST = 1e6  # of a tensor; a speed nobody measured is stored as this, weights are below 200, and 1e30 overflows


def save_config(folder: Path, settings: config.Listener) -> None:
    """Write `folder`/config.yaml. Raises ModelError where it cannot be written."""
    text = yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False, width=110, default_flow_style=None)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / CONFIG).write_text(text, encoding="utf-8")
    except OSError as error:
        raise ModelError(f"{folder / CONFIG}: cannot be written: {error.strerror}") from error


def save_weights(file: Path, module: nn.Module, half: bool = False) -> None:
    """Write the state of `module`, replacing `file` in one move so that an interrupted run leaves the old one.

    `half`: in 16 bits, which is half the room; what loads it computes in 32 again. Raises ModelError where it cannot
    be written, and leaves no part of it.
    """
    part = file.with_suffix(".part")
    state = {
        name: value.half() if half and value.is_floating_point() else value
        for name, value in module.state_dict().items()
    }
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        save_file({name: value.contiguous() for name, value in state.items()}, part)
        part.chmod(0o644)  # safetensors leaves it readable by its owner alone
        part.replace(file)
    except (OSError, SafetensorError) as error:
        if part.is_file():
            part.unlink()
        raise ModelError(f"{file}: cannot be written: {error}") from error


def load_weights(file: Path, module: nn.Module) -> None:
    """Fill `module` from a safetensors file: plain numbers, no code is run.

    Raises ModelError when the file or a tensor is missing, cut off, of another shape or type, not finite, or of values
    that no trained model has.
    """
    if not file.is_file():
        raise ModelError(f"{file}: no such weights file")
    try:
        found = load_file(file)
    except (SafetensorError, OSError) as error:
        raise ModelError(f"{file}: not a readable safetensors file: {error}") from error
    for name, expected in module.state_dict().items():
        if name not in found:
            raise ModelError(f"{file}: tensor {name} is missing; the weights belong to another configuration")
        if found[name].shape != expected.shape:
            raise ModelError(
                f"{file}: tensor {name} has shape {tuple(found[name].shape)}, "
                f"the configuration needs {tuple(expected.shape)}"
            )
        if found[name].is_floating_point() != expected.is_floating_point():
            raise ModelError(f"{file}: tensor {name} is of {found[name].dtype}, the model needs {expected.dtype}")
        if not bool(found[name].isfinite().all()):
            raise ModelError(f"{file}: tensor {name} holds values that are not finite")
        if found[name].numel() and (largest := float(found[name].abs().max())) > LARGEST:
            raise ModelError(f"{file}: tensor {name} holds {largest:g}, no trained model is above {LARGEST:g}")
    extra = sorted(set(found) - set(module.state_dict()))
    if extra:
        raise ModelError(f"{file}: tensor {extra[0]} is not part of the configured model")
    module.load_state_dict(found)


def load_config(folder: Path) -> config.Listener:
    """Read `folder`/config.yaml. Raises ConfigError."""
    return config.load_listener(folder / CONFIG)
