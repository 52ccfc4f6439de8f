"""Listeners by name: shipped, in a folder, or in another package. torch is imported only where it is needed."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

from sfms_robot import config
from sfms_robot.config.listener import Calmness
from sfms_robot.errors import ConfigError, optional
from sfms_robot.listeners.arig.stream import ArigListener
from sfms_robot.listeners.checkpoint import load_config
from sfms_robot.listeners.engine import Device, Engine, EngineName, OnnxEngine, graphs_to_run
from sfms_robot.listeners.eventful import EventfulListener
from sfms_robot.listeners.events.model import EventModel
from sfms_robot.listeners.idle import FILE as IDLE_FILE
from sfms_robot.listeners.idle import IdleMotion
from sfms_robot.listeners.sfms.stream import SfmsListener
from sfms_robot.plugins import listener_folder, load_plugin
from sfms_robot.ports import Listener


def load_listener(
    name: str | Path,
    calmness: Calmness | None = None,
    engine: EngineName = "auto",
    threads: int | None = None,
    device: Device = "cpu",
) -> Listener:
    """Load a listener by its shipped name, from a folder with config.yaml and weights, or from another package.

    Shipped listeners are `engine.RunsOnEngine`s.

    Args:
        calmness: rates of the events of a listener that decides them.
        engine: engine of its networks (`engine`); auto: onnx if possible, else torch.
        threads: number of threads of its networks; None: one with onnx, the number that torch is set to with torch.
        device: cuda computes many streams at once on a GPU (`torch_engine.BatchEngine`).

    Raises ConfigError or ModelError.
    """
    folder = listener_folder(str(name))
    if folder is None:
        if device != "cpu":
            raise ConfigError(f"--device {device}: {name} is of another package, which computes where it does")
        return load_plugin(str(name))
    moves = load_folder(folder, engine, threads, device)
    listener: Listener = moves
    if moves.settings.events:
        resting = folder / IDLE_FILE
        idle = IdleMotion.load(resting) if resting.is_file() else None
        listener = EventfulListener(moves, EventModel.load(), calmness, idle)
    return listener


def load_folder(
    folder: Path, engine: EngineName = "auto", threads: int | None = None, device: Device = "cpu"
) -> SfmsListener | ArigListener:
    """Load the model of motion of a folder with config.yaml and model.safetensors. Raises ConfigError, ModelError."""
    settings = load_config(folder)
    if device != "cpu" and engine == "onnx":
        raise ConfigError(f"--engine onnx: computes on processors, --device {device} does not (valid: auto, torch)")
    graphs = graphs_to_run(folder, settings, engine) if device == "cpu" else None
    runs: Engine
    if graphs is not None:
        runs = OnnxEngine(folder, graphs, threads or 1)
    else:
        with optional(f"{folder}: a listener without graphs of engine onnx"):
            from sfms_robot.listeners.torch_engine import load_model, torch_engine

            runs = torch_engine(load_model(folder), device)
        if threads is not None:
            runs.set_threads(threads)
    if isinstance(settings, config.Sfms):
        return SfmsListener(settings, runs, folder)
    assert isinstance(settings, config.Arig)
    return ArigListener(settings, runs, folder)


def engine_name(listener: Listener) -> str | None:
    """Return the name of the engine of a listener's networks; None for a listener of another package."""
    engine: Engine | None = getattr(listener, "engine", None)
    return None if engine is None else engine.name


def set_threads(listener: Listener, threads: int) -> None:
    """Set the number of threads of a listener; one of another package stays unchanged."""
    engine: Engine | None = getattr(listener, "engine", None)
    if engine is not None:
        engine.set_threads(threads)


def hops_of(listener: Listener) -> tuple[int, ...]:
    """Return the hops that a listener supports: its current hop if it has no `hops`."""
    return tuple(getattr(listener, "hops", (listener.hop,)))


def at_hop(listener: Listener, hop: int) -> Listener:
    """Return the listener with a plan every `hop` frames; `hop` is one of `hops_of`."""
    return listener if hop == listener.hop else cast(Listener, cast(Any, listener).at_hop(hop))


def one_thread() -> None:
    """Use one thread in torch, so that sums are added in one order and results repeat exactly."""
    import torch

    torch.set_num_threads(1)
