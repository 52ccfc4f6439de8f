"""The computation of one frame of a stream, as functions of tensors: `FrameNetwork` up to the sampler, `DrawNetwork`.

Offline the same parts run over all frames at once (`model.condition`); a law of the tests is that both agree. As
functions of tensors alone they can be exported. `RestNetwork` makes the memory before the first frame. Below them is
the choice of layers that graphs may have in 8-bit integers.

N streams, mostly one; A features of sound, C channels, D width, K numbers of a control row, c frames of a chunk, S
whole chunks that are kept, L layers that look at them.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from sfms_robot.listeners.arig.model import ArigModel
from sfms_robot.listeners.layers import Network, Tensors


class RestNetwork(Network[ArigModel]):
    """A still face and silence as the memory of a stream: called once, when a listener is loaded."""

    def forward(self, still: Tensor) -> Tensors:
        """Return embedded motion and silence (1, D), and their keys (1, 2D), of standardised motion `still` (1, C)."""
        progress, motion, silence = self.model.progress, self.model.embed_own(still), self.model.no_agent_sound[None]
        return motion, silence + 0.0, progress.temporal.keys(motion), progress.coarse.keys(silence)


class FrameNetwork(Network[ArigModel]):
    """Sounds and face of one frame, and the memory of the stream -> the inputs of the sampler for the next."""

    def __init__(self, model: ArigModel) -> None:
        super().__init__(model)
        layers = range(model.settings.context_layers)
        self.further = [f"{part}_{layer}" for layer in layers for part in ("keys", "values")]  # names of `past`

    def forward(
        self,
        sounds: Tensor,
        heard: Tensor,
        voiced: Tensor,
        face: Tensor,
        seen: Tensor,
        first: Tensor,
        state: Tensor,
        rotary: Tensor,
        view: Tensor,
        agent_sound: Tensor,
        agent_behaviour: Tensor,
        user_behaviour: Tensor,
        sound_keys: Tensor,
        motion: Tensor,
        motion_keys: Tensor,
        sample: Tensor,
        rows: Tensor,
        *past: Tensor,
    ) -> Tensors:
        """Process one frame, equation (2).

        Args:
            sounds: (N, 2, A) of user and agent; heard: (N, 2) bool, which of them are there.
            voiced: (N, 2) bool, speech of agent, user.
            face: (N, C) standardised motion of the user; seen: (N,) bool.
            first: (N,) bool, first frame of the stream: chunks begin as its behaviour repeated (A.2).
            state: (N,) conversational state of the frame before.
            rotary, view, past: arguments of `LongRange.step`: place, chunks that there have been, keys and values.
            agent_sound, ...: fields of `stream.ArigMemory`.
            rows: (N, 2K) control of the frame before and of the frame to be made; arbitrary without events.

        Returns:
            z (N, D) with the further inputs of the sampler, logits of the state (N, 7 or 9), empty without states, keys
            and values of the chunk in progress, and the next agent_sound, agent_behaviour, user_behaviour and
            sound_keys.
        """
        model = self.model
        embedded = model.embed_sound(sounds, heard, torch.stack([model.no_user_sound, model.no_agent_sound]))
        user_sound, now = embedded[:, 0], embedded[:, 1]  # A^u_(T-1) and A^a_T, (N, D)
        face = model.embed_face(face, seen)  # M^u_(T-1)
        # 3.2: behaviours I_(T-1) of both; the agent's is made with the sound kept from the frame before.
        agent_behaviour = _after(agent_behaviour, model.merge_agent(agent_sound, motion), first)
        user_behaviour = _after(user_behaviour, model.merge_user(user_sound, face), first)
        sound_keys = push(sound_keys, model.progress.coarse.keys(now))
        summary = model.short(agent_behaviour, user_behaviour, now, user_sound)  # 3.2, short range
        cis, made = model.long.step(summary, past, view, rotary)  # 3.2, long range: the cis-token
        feature, logits = None, cis[:, :0]
        if model.states is not None:  # 3.3: S_T and s_T
            feature, logits = model.states(model.states.condition(cis, voiced), state)
        events = model.embed_events(rows)  # ours
        outline = model.progress.coarse(motion, sound_keys)  # 3.4: M^a_(T-1) looks at the sounds of three frames
        z = model.progress.refine(outline, motion_keys, now, cis, feature, events)  # 3.4: latent z
        z = model.beside(z, events, sample)
        return z, logits, made, now, agent_behaviour, user_behaviour, sound_keys


class DrawNetwork(Network[ArigModel]):
    """Inputs of the sampler and its noise -> the agent's motion, and the memory of it."""

    def forward(
        self,
        z: Tensor,
        noise: Tensor,
        standard: Tensor,
        motion_keys: Tensor,
        rows: Tensor | None = None,
        speaks: Tensor | None = None,
    ) -> Tensors:
        """Draw one frame.

        Args:
            z: output of `FrameNetwork`; noise: (N, *noise_shape).
            standard: (N, C) standardised motion of the frame before; motion_keys: field of `stream.ArigMemory`.
            rows: (N, 2K) as in `FrameNetwork`, and speaks: (N,) bool, the agent's speech; for a listener with events.

        Returns:
            Motion (N, C) in plain units, the same standardised (N, C), `model.moved` (N, C), embedded (N, D), and the
            next motion_keys.
        """
        model = self.model
        made = model.drawn(model.sample(z, noise), standard, rows, speaks)  # equation (4), then ours
        motion = model.embed_own(made)  # M^a_T, the past of the next frame
        keys = push(motion_keys, model.progress.temporal.keys(motion))
        return model.restore(made), made, model.moved(made, standard, rows), motion, keys


def push(queue: Tensor, new: Tensor) -> Tensor:
    """Return (N, S, D) without its oldest row and with `new` (N, D) as its newest."""
    return torch.cat([queue[:, 1:], new[:, None]], dim=1)


def _after(queue: Tensor, new: Tensor, first: Tensor) -> Tensor:
    """Return (N, S, D) with `new` (N, D) as its newest, or `new` repeated where `first` (N,)."""
    return torch.where(first[:, None, None], new[:, None], push(queue, new))


def networks(model: ArigModel) -> dict[str, Network[ArigModel]]:
    """Return all networks by name."""
    return {"rest": RestNetwork(model), "frame": FrameNetwork(model), "draw": DrawNetwork(model)}


# --- Large layers in 8 bits -------------------------------------------------------------------------------------------
#
# Dynamic quantization, of graphs. For one frame at a time, the cost of a layer is the time to read its weights, and
# bytes take a quarter of it. Weights are rounded per output row, the input by its own range. Small layers stay in 32
# bits: they gain nothing. The sampler's blocks in integers stay in the fastest cache.

PARTS = ("sound_in", "merge_agent", "merge_user", "short", "long", "states", "progress")
SAMPLER = ("head.modulation.", "head.up.", "head.down.")  # all products of a step except the first and the last
SMALLEST = 64 * 1024  # weights of a layer below which integers gain nothing


def large_layers(model: ArigModel) -> list[str]:
    """Return the weights, by name, of the layers that graphs have in integers."""
    return [
        f"{name}.weight"
        for name, part in model.named_modules()
        if isinstance(part, nn.Linear)
        and (name.split(".")[0] in PARTS or name.startswith(SAMPLER))
        and part.weight.numel() >= SMALLEST
    ]
