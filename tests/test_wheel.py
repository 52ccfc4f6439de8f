"""The wheel: what goes into it, and how large it gets."""

import tomllib
import zlib
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parent.parent
LARGEST_BYTES = 16_000_000
OF_A_FILE_BYTES = 300  # its names and places in the archive and in RECORD


def packed_files():
    wheel = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    left_out = [CHECKOUT / name.lstrip("/") for name in wheel["exclude"]]
    for folder in wheel["only-include"]:
        for file in (CHECKOUT / folder).rglob("*"):
            if file.is_file() and file.suffix != ".pyc" and not any(file.is_relative_to(each) for each in left_out):
                yield file


def test_it_is_below_16_megabytes():
    sizes = {file: len(zlib.compress(file.read_bytes())) + OF_A_FILE_BYTES for file in packed_files()}
    assert len(sizes) > 300
    largest = sorted(sizes, key=sizes.__getitem__, reverse=True)[:8]
    assert sum(sizes.values()) < LARGEST_BYTES, {str(file.relative_to(CHECKOUT)): sizes[file] for file in largest}
