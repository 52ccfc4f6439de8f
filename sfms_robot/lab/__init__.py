"""Corpora, training, evaluation and benches. Only the commands that start them import this folder."""

from typing import Any

Figures = dict[str, Any]  # plain data, as --json prints it
