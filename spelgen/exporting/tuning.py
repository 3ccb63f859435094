"""Constants of the exports."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ExportTuning:
    """How an export is held against the model, and how the nearest rigid bodies are found."""

    states: int = 200  # [1] random states of a parity check
    # [1] of C, CasADi and torch, relative to the largest value; docs/deploy.md: 4e-14
    tolerance: float = 1e-12
    onnx_tolerance: float = 1e-10  # [1] of ONNX, likewise; looser where M is ill-conditioned
    mujoco_tolerance: float = 1e-9  # [1] of MuJoCo, likewise; docs/deploy.md: 9e-15
    tip_tolerance: float = (
        3e-6  # [1] more for the tip, likewise: pytorch-kinematics rounds offsets to float32
    )
    positions: int = 512  # [1] random positions at which a model and the nearest bodies are compared
    steps: int = 400  # [1] of the optimiser towards the nearest bodies
    # [1] weight of the difference to the URDF's bodies, where M and gravity leave it open
    ridge: float = 1e-8
    friction_positions: int = 32  # [1] of these positions, for the nearest viscous and Coulomb friction
    friction_impedance: tuple[float, ...] = (0.9999, 0.9999, 0.001, 0.5, 2.0)
    # [1] MuJoCo's solimpfriction, as hard as it has friction: by its default a loaded joint creeps at rest
    friction_speeds: int = 25  # [1] speeds each way, from 2 % to all of a joint's usual speed


TUNING = ExportTuning()
