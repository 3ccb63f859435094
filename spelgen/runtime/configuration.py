"""All that is computed of q alone by a model of networks."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class Configuration(NamedTuple):
    """A position as networks and Fourier series read it; or how fast that changes."""

    encoded: Tensor  # (..., 2 n) or (..., 3 n), see JointEncoding
    fourier: Tensor | None  # (..., 2 K), see FourierFeatures
