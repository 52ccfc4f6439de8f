"""How ARIG learns: state labels, its corpus, losses, trainer, and what it is worth on held-out conversations."""
