"""Training of ARIG: its corpus, losses and trainer."""
