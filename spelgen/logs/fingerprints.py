"""Fingerprints of recordings, by which copies and parts of a recording are recognized under another name."""

from collections import Counter
from collections.abc import Collection

import numpy as np

SIZE = 32
"""Number of hashes in a fingerprint. Recordings with a common quarter of their samples share about 8."""
RUN = 4
"""Number of consecutive samples from which a hash is computed."""


class Fingerprints:
    """Collection of fingerprints, which finds the recording of which another recording is a copy or a part.

    A fingerprint is the result of `smallest_hashes`. Recordings are identified by their names.
    """

    def __init__(self) -> None:
        self._recordings: dict[str, Collection[int]] = {}
        self._names: dict[int, str] = {}

    def add(self, name: str, fingerprint: Collection[int]) -> None:
        """Add the fingerprint (hashes of samples) of the recording `name`, so that later copies of it are found."""
        self._recordings[name] = fingerprint
        for number in fingerprint:
            self._names.setdefault(number, name)

    def original(self, fingerprint: Collection[int]) -> str | None:
        """Return the name of an added recording that shares samples with the recording of `fingerprint`, or None.

        The two recordings must share at least a quarter of the samples of the shorter one. This fraction is estimated
        from the hashes that both fingerprints contain.
        """
        common = Counter(self._names[number] for number in fingerprint if number in self._names)
        if not common:
            return None
        name, count = common.most_common(1)[0]
        return name if 4 * count >= min(len(fingerprint), len(self._recordings[name])) else None


def smallest_hashes(q: np.ndarray, inputs: np.ndarray) -> list[int]:
    """Return the `SIZE` smallest hashes of runs of `RUN` consecutive samples in motion, [] without motion.

    The hashes are the fingerprint of a recording (bottom-k sketch, Broder 1997): recordings that share samples share
    hashes. Values are rounded to single precision before. Samples at rest are omitted, since different recordings may
    have the same rest position.

    q: (T, n) positions. inputs: (T, m) torques or commands.
    """
    # Zero is added because -0.0 and 0.0 have different bits.
    values = np.hstack([q, inputs]).astype(np.float32) + np.float32(0)
    hashes = _hashes(values.view(np.uint32).astype(np.uint64))
    runs = np.lib.stride_tricks.sliding_window_view(hashes, min(RUN, len(hashes)))
    moving = (q[len(q) - len(runs) :] != q[: len(runs)]).any(axis=1)
    return [int(number) for number in np.unique(_hashes(runs[moving]))[:SIZE]]


def _hashes(words: np.ndarray) -> np.ndarray:
    """Return a hash (T,) of each row of words (T, k), 64-bit unsigned integers (splitmix64 of a weighted sum)."""
    weights = np.uint64(0x9E3779B97F4A7C15) ** np.arange(1, words.shape[1] + 1, dtype=np.uint64)
    number = words @ weights
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        number = (number ^ (number >> np.uint64(shift))) * np.uint64(factor)
    return number ^ (number >> np.uint64(31))
