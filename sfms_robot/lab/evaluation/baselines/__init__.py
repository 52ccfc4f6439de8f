"""Tokenizers that sparse keyframes are compared with: one code a frame, and one code every eight frames."""
