"""Constants of the derivation of the structure."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class StructureTuning:
    """Limits of the search for the minimal form, and magnitudes of an untrained model."""

    # [1] Joints up to which outputs of all 2^n subsets of joints are considered; longer arms have outputs of
    # contiguous ranges only.
    all_subsets_up_to: int = 8
    # [1] Samples in addition to the largest possible dimension of a span: they would reveal a larger dimension.
    spare_samples: int = 4
    # [1] A smaller singular value, relative to the largest, is a rounding error.
    zero_singular_value: float = 1e-9
    # [1] Difference below which components of null vectors count as equal; their errors are a thousand times larger
    # than the errors of the matrix.
    equal_components: float = 1e-6
    # [1] Random configurations of the workspace over which magnitudes are averaged.
    points: int = 512
    # [1] Smallest expected magnitude of an output, as a fraction of the entries that it contributes to.
    min_scale: float = 0.05
    # [1] Smallest sensitivity to a joint, as a fraction of the largest: a joint with a negligible nominal effect
    # remains an input.
    min_sensitivity: float = 0.02
    # [m] Radius of gyration of the body of one kilogram that represents a link without inertial.
    default_gyration: float = 0.1
    # [1] Eigenvalues of the pseudo-inertia of a physically inconsistent body are raised to this fraction of the
    # largest.
    min_pseudo_eigenvalue: float = 1e-4


TUNING = StructureTuning()
