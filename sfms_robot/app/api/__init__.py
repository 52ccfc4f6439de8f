"""The public API: the parts of a run alone, and a run in a thread."""
