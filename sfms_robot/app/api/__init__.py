"""The public API: single parts of a run, and a run in a thread."""
