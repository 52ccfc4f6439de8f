"""A robot head that listens: voice in, servo goals out."""

__version__ = "0.1.0"
