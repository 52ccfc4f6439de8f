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


def save_config(folder: Path, settings: config.Listener) -> None:
    """Write `folder`/config.yaml."""
    folder.mkdir(parents=True, exist_ok=True)
    text = yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False, width=110, default_flow_style=None)
    (folder / CONFIG).write_text(text, encoding="utf-8")


def save_weights(file: Path, module: nn.Module, half: bool = False) -> None:
    """Write the state of `module`, replacing `file` in one move so that an interrupted run leaves the old one.

    `half`: in 16 bits, which is half the room; what loads it computes in 32 again.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_suffix(".part")
    state = {
        name: value.half() if half and value.is_floating_point() else value
        for name, value in module.state_dict().items()
    }
    save_file({name: value.contiguous() for name, value in state.items()}, part)
    part.chmod(0o644)  # safetensors leaves it readable by its owner alone
    part.replace(file)


def load_weights(file: Path, module: nn.Module) -> None:
    """Fill `module` from `file`. Raises ModelError when the file or a tensor is missing, corrupt, or does not fit."""
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
        if not bool(found[name].isfinite().all()):
            raise ModelError(f"{file}: tensor {name} holds values that are not finite")
    extra = sorted(set(found) - set(module.state_dict()))
    if extra:
        raise ModelError(f"{file}: tensor {extra[0]} is not part of the configured model")
    module.load_state_dict(found)


def load_config(folder: Path) -> config.Listener:
    """Read `folder`/config.yaml. Raises ConfigError."""
    return config.load_listener(folder / CONFIG)
