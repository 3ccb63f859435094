"""Constants of the derivation of the structure."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class StructureTuning:
    """Hold what decides how far the structure is searched, and the sizes a model starts with."""

    all_subsets_up_to: int = 8  # joints: longer arms have outputs of contiguous ranges only (2^n sets else)
    spare_samples: int = 4  # beyond the dimension a span can have: they would show a larger one
    points: int = 512  # configurations over the workspace that sizes are means of
    least_size: float = 0.05  # of the entries an output enters: the least it is expected to move
    least_sensitivity: float = 0.02  # of the largest: a joint that nominally matters less is still seen
    default_gyration: float = 0.1  # [m] of the one-kilogram ball that stands for a link without inertial
    least_pseudo_eigenvalue: float = 1e-4  # of the largest: to it those of an impossible body are raised


TUNING = StructureTuning()
