"""Constants of the derivation of the structure."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class StructureTuning:
    """How far the structure is searched, and the magnitudes that an untrained model starts with."""

    # [1] Joints up to which outputs of all 2^n subsets of joints are considered; longer arms have outputs of
    # contiguous ranges only.
    all_subsets_up_to: int = 8
    # [1] Samples in addition to the largest possible dimension of a span: a larger dimension would be seen.
    spare_samples: int = 4
    # [1] Random configurations of the workspace over which magnitudes are averaged.
    points: int = 512
    # [1] Smallest expected magnitude of an output, as a fraction of the entries that it enters.
    least_size: float = 0.05
    # [1] Smallest sensitivity to a joint, as a fraction of the largest: a joint with a negligible nominal effect
    # remains an input.
    least_sensitivity: float = 0.02
    # [m] Radius of gyration of the body of one kilogram that represents a link without inertial.
    default_gyration: float = 0.1
    # [1] Eigenvalues of the pseudo-inertia of a physically inconsistent body are raised to this fraction of the
    # largest.
    least_pseudo_eigenvalue: float = 1e-4


TUNING = StructureTuning()
