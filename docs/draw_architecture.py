"""Draw docs/architecture.png: `python docs/draw_architecture.py` (needs matplotlib)."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.patches import FancyBboxPatch

# (package, task, output), in the order that a frame of 40 ms passes
CHAIN = [
    ("sources", "the person", "SpeakerFrame:\nsound and face, 40 ms"),
    ("listeners", "SFMS, ARIG, yours", "Plan: our face for\nthe coming frames"),
    ("motion", "timeline", "the face at the\ntime of this tick"),
    ("retarget", "a face on this head", "joint angles [rad]"),
    ("motion", "limiter", "goals inside\nall limits [rad]"),
    ("servo", "buses, codecs", "packets"),
]
AROUND = [
    ("cli", "commands"),
    ("app", "puts a run together"),
    ("runtime", "loop, states, halt, recorder"),
    ("viewer", "page, status"),
]
BELOW = [
    ("config", "YAML, validated once"),
    ("signals", "features of sound and face"),
    ("emulator", "servos without hardware"),
    ("lab", "training, evaluation, bench"),
]
INK, FAINT, FILL = "#22303c", "#8795a1", "#eef3f7"
WIDTH, STEP = 2.0, 2.75


def box(x, y, name, text, width=WIDTH):
    shape = FancyBboxPatch((x, y), width, 0.7, boxstyle="round,pad=0.04", facecolor=FILL, edgecolor=INK)
    axes.add_patch(shape)
    axes.text(x + width / 2, y + 0.46, name, ha="center", va="center", fontsize=12, weight="bold", color=INK)
    axes.text(x + width / 2, y + 0.17, text, ha="center", va="center", fontsize=9, color=INK)


figure, axes = plt.subplots(figsize=(14.5, 4.6))
axes.set(xlim=(-0.2, 16.9), ylim=(-0.2, 4.1))
axes.axis("off")
for index, (name, text, leaves) in enumerate(CHAIN):
    x = STEP * index
    box(x, 1.75, name, text)
    axes.annotate("", (x + STEP - 0.08, 2.1), (x + WIDTH + 0.08, 2.1), arrowprops={"arrowstyle": "-|>", "color": INK})
    axes.text(x + (WIDTH + STEP) / 2, 1.55, leaves, ha="center", va="top", fontsize=8.5, color=INK)
for row, y in ((AROUND, 3.3), (BELOW, 0.0)):
    for index, (name, text) in enumerate(row):
        box(0.6 + 3.9 * index, y, name, text, width=3.0)
axes.text(0, 2.75, "runtime/loop.py takes these in order at every tick", fontsize=9, style="italic", color=FAINT)
figure.savefig(Path(__file__).with_name("architecture.png"), dpi=100, bbox_inches="tight", facecolor="white")
