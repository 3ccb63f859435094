"""Constants of the exports."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ExportTuning:
    """Constants of parity checks, of the projection onto the nearest rigid bodies, and of MJCF files."""

    # [1] Number of random states of a parity check.
    states: int = 200
    # [1] Largest allowed difference between results of C, CasADi or torch programs and of the model, divided by the
    # largest value of the result. `benchmarks/deploy.py` measures 4e-14.
    tolerance: float = 1e-12
    # [1] Largest allowed difference of ONNX programs, relative like `tolerance`. It is larger because they solve linear
    # systems without pivoting, and M may be ill-conditioned.
    onnx_tolerance: float = 1e-10
    # [1] Largest allowed difference of float32 programs, relative like `tolerance`. Solving with an ill-conditioned M
    # loses digits.
    float32_tolerance: float = 1e-3
    # [1] Largest allowed difference of MuJoCo's dynamics, relative like `tolerance`. `benchmarks/deploy.py` measures
    # 9e-15.
    mujoco_tolerance: float = 1e-9
    # [1] Number of random positions at which M and gravity torque of rigid bodies are fitted to a model that has no
    # rigid bodies, by least squares (the nearest rigid bodies, `_nearest_bodies`).
    positions: int = 512
    # [1] Number of optimizer steps of the same fit.
    steps: int = 400
    # [1] Weight r of the ridge term r/2 |x|^2 in the same fit; x are the differences of the parameters from the URDF.
    # The term determines the parameters on which M and gravity torque do not depend.
    ridge: float = 1e-8
    # [1] Number of random positions at which viscous and Coulomb friction are fitted to the friction of a model.
    friction_positions: int = 32
    # [1] MuJoCo's solimpfriction, its stiffest values: with the default, a loaded joint at rest slips slowly.
    friction_impedance: tuple[float, ...] = (0.9999, 0.9999, 0.001, 0.5, 2.0)
    # [1] Number of speeds per direction, from 2 % to 100 % of a joint's nominal speed, at which friction is
    # fitted.
    friction_speeds: int = 25
    # [1] Maximum total number of triangles in all meshes of an MJCF.
    faces: int = 20_000
    # [1] A mesh whose thickness divided by its length is at most this number is omitted, since MuJoCo refuses
    # flat meshes.
    flat: float = 1e-5


TUNING = ExportTuning()
