"""Constants of the exports."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ExportTuning:
    """Constants of parity checks, of the projection onto the nearest rigid bodies, and of MJCF files."""

    # [1] Number of random states of a parity check.
    states: int = 200
    # [rad/s] Nominal speed of a revolute joint whose URDF has no velocity limit, for the states of parity
    # checks.
    angular_speed: float = 1.0
    # [m/s] Nominal speed of a prismatic joint whose URDF has no velocity limit.
    linear_speed: float = 0.3
    # [1] Largest allowed difference between C, CasADi and torch programs and the model, relative to the
    # largest value; `benchmarks/deploy.py` measures 4e-14.
    tolerance: float = 1e-12
    # [1] Largest allowed relative difference of ONNX programs; larger than `tolerance`, because M may be
    # ill-conditioned.
    onnx_tolerance: float = 1e-10
    # [1] Largest allowed relative difference of float32 programs; solving with an ill-conditioned M loses
    # digits.
    float32_tolerance: float = 1e-3
    # [1] Largest allowed relative difference of MuJoCo's dynamics; `benchmarks/deploy.py` measures 9e-15.
    mujoco_tolerance: float = 1e-9
    # [1] Number of random positions at which the nearest rigid bodies are fitted to a model.
    positions: int = 512
    # [1] Number of optimizer steps of the fit of the nearest rigid bodies.
    steps: int = 400
    # [1] Weight of the penalty on the distance from the URDF's parameters, which fixes parameters that M and
    # gravity do not determine.
    ridge: float = 1e-8
    # [1] Number of the random positions at which viscous and Coulomb friction are fitted.
    friction_positions: int = 32
    # [1] MuJoCo's solimpfriction: the stiffest values, since a loaded joint at rest creeps with the default.
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
