"""Random streams that do not disturb each other: a name and a seed give each its own."""

from __future__ import annotations

import zlib

import numpy as np


def stream(seed: int, *labels: str | int) -> np.random.Generator:
    """A generator that depends on the seed and the labels only.

    Every frame and every stage of the noise draws from its own stream, so switching one stage off
    or resuming after a crash leaves all other random numbers as they were.
    """
    keys = [zlib.crc32(str(label).encode()) for label in labels]
    return np.random.default_rng(np.random.SeedSequence([seed, *keys]))
