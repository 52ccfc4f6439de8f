"""Many streams in one batch on a GPU: the engine's laws, on a CPU and on torch's device without values."""

import numpy as np
import pytest
import torch
from remote_rig import Counting
from test_stream_server import frame, joined, stepped
from tiny_arig import arig_listener, arig_model, talk
from tiny_sfms import told_listener
from torch import nn
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.listeners.arig.stream import ArigListener
from sfms_robot.listeners.registry import load_folder
from sfms_robot.listeners.sfms.stream import SfmsListener
from sfms_robot.listeners.stream_server import StreamServer
from sfms_robot.listeners.torch_engine import ONE_STREAM, BatchEngine, RecordingEngine, networks_of, torch_engine
from sfms_robot.signals.control import COLUMNS

TOLD = {"events": True, "draws": "innovation", "sway": True}
CPU = torch.device("cpu")
LISTENERS = {
    "arig told of events": lambda: arig_listener(**TOLD),
    "arig": arig_listener,
    "arig codes": lambda: arig_listener(discrete=True),
    "sfms told of events": told_listener,
}
LOOKS = {"item", "tolist", "numpy", "cpu", "__bool__", "__int__", "__float__", "nonzero"}
MAKES = {torch.tensor, torch.as_tensor, torch.from_numpy, torch.asarray}


class NothingOfTheHost(TorchFunctionMode):
    """Fails where a value is looked at, or a tensor is made from numbers of Python: both end a capture."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        name = getattr(func, "__name__", "")
        assert name not in LOOKS and func not in MAKES, f"{name} in a step"
        if name == "__getitem__":
            index = args[1] if isinstance(args[1], tuple) else (args[1],)
            assert not any(isinstance(each, list | np.ndarray) for each in index), "a list as an index"
        return func(*args, **(kwargs or {}))


class OneDevice(TorchDispatchMode):
    """Fails where an operation takes or makes a tensor elsewhere."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        found = [each for each in tree_leaves((args, kwargs, out)) if isinstance(each, torch.Tensor)]
        assert all(each.device.type == "meta" for each in found), f"{func}: a tensor on the CPU"
        return out


def on(listener, make):
    """Return the same listener on an engine that `make` makes of its model."""
    kind = ArigListener if isinstance(listener, ArigListener) else SfmsListener
    return kind(listener.model.settings, make(listener.model, networks_of(listener.model)))


def rolled(listener, streams, frames=9):
    """Return the frames of all plans of so many different streams."""
    memories, plans = [listener.start(seed) for seed in range(streams)], []
    rows = np.zeros((sum(listener.control_frames), len(COLUMNS)), np.float32)
    speakers = [talk(frames, seed) for seed in range(streams)]
    for at in range(frames):
        controls = [rows if len(rows) else None] * streams
        answers = listener.step_each([each[at] for each in speakers], memories, controls)
        memories = [memory for _, memory in answers]
        plans += [plan.frames for plan, _ in answers if plan is not None]
    return plans


@pytest.mark.parametrize("kind", LISTENERS)
def test_nothing_of_a_step_is_made_on_the_cpu(kind):
    listener = on(LISTENERS[kind](), RecordingEngine)
    rolled(listener, 3)
    examples, model = listener.engine.examples, listener.model.to("meta")
    for name, network in networks_of(model).items():
        inputs = [each.to("meta") for each in examples[name].values()]
        with torch.inference_mode():
            network(*inputs)  # makes what is made once, such as places
            if name != ONE_STREAM:
                with NothingOfTheHost(), OneDevice():
                    network(*inputs)


@pytest.mark.parametrize("kind", LISTENERS)
@pytest.mark.parametrize("streams", [1, 3, 4])
def test_a_batch_has_the_plans_of_each_stream_alone(kind, streams):
    listener = LISTENERS[kind]()
    expected = rolled(listener, streams)
    batched = on(listener, lambda model, networks: BatchEngine(model, networks, CPU))
    assert batched.engine.name == "torch on cpu"
    for plan, wanted in zip(rolled(batched, streams), expected, strict=True):
        np.testing.assert_allclose(plan, wanted, atol=1e-3)


def test_what_an_engine_returned_stays_and_a_gpu_without_memory_is_said_in_one_line():
    engine = BatchEngine(nn.Identity(), {"same": Same()}, CPU)
    first = engine.run("same", np.ones((3, 2), np.float32))[0]
    engine.run("same", np.zeros((3, 2), np.float32))
    assert (first == 1).all()
    engine = BatchEngine(nn.Identity(), {"same": Same()}, CPU)
    with pytest.raises(MemoryError, match="^too little memory on the GPU for 5 heads at once$"):
        engine.run("same", np.ones((5, 2), np.float32))
    assert len(engine.run("same", np.ones((4, 2), np.float32))[0]) == 4


class Same(nn.Module):
    def forward(self, x):
        if len(x) > 4:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20 GiB.\nSee documentation")
        return (x,)


def test_a_batch_that_was_too_large_comes_in_halves_and_one_such_stream_joins_again():
    server = StreamServer(Counting(), "counting")
    for client in "abcdef":
        server.receive(joined(server, client), frame(0), 0.0)
    server.too_many(server.batch())
    assert server.heads == 6 and len(server.batch()) == 3
    server = StreamServer(Counting(), "counting")
    server.receive(joined(server, "a"), frame(0), 0.0)
    server.too_many(server.batch())
    assert server.heads == 0 and stepped(server) == []


@pytest.mark.skipif(torch.cuda.is_available(), reason="here is a GPU")
def test_without_a_gpu_it_is_refused():
    with pytest.raises(ConfigError, match="^--device cuda: torch sees no CUDA device here \\(valid: cpu\\)$"):
        torch_engine(arig_model(), "cuda")


def test_onnx_computes_on_processors():
    with pytest.raises(ConfigError, match="^--engine onnx: computes on processors, --device cuda does not"):
        load_folder(data_dir("configs") / "listeners" / "sfms-small", "onnx", device="cuda")
