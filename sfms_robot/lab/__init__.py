"""Corpora, training, evaluation and benches. Only the commands that start them import this folder."""
