"""Constants of the exports."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ExportTuning:
    """Parity checks of exports, and the projection onto the nearest rigid bodies."""

    # [1] Random states of a parity check.
    states: int = 200
    # [rad/s] Speed of a revolute joint without a velocity limit in these states.
    angular_speed: float = 1.0
    # [m/s] Speed of a prismatic joint without a velocity limit.
    linear_speed: float = 0.3
    # [1] Largest difference of C, CasADi and torch programs, relative to the largest value; `benchmarks/deploy.py`
    # measures 4e-14.
    tolerance: float = 1e-12
    # [1] Largest relative difference of ONNX programs; larger because M may be ill-conditioned.
    onnx_tolerance: float = 1e-10
    # [1] Largest relative difference of float32 programs, whose eliminations lose digits if M is ill-conditioned.
    float32_tolerance: float = 1e-3
    # [1] Largest relative difference of MuJoCo; `benchmarks/deploy.py` measures 9e-15.
    mujoco_tolerance: float = 1e-9
    # [1] Random positions at which a model and the nearest rigid bodies are compared.
    positions: int = 512
    # [1] Steps of the optimizer towards the nearest rigid bodies.
    steps: int = 400
    # [1] Weight of the difference to the URDF's parameters in directions that M and gravity do not determine.
    ridge: float = 1e-8
    # [1] Number of these positions at which viscous and Coulomb friction are projected.
    friction_positions: int = 32
    # [1] MuJoCo's solimpfriction at its stiffest: with the default a loaded joint creeps at rest.
    friction_impedance: tuple[float, ...] = (0.9999, 0.9999, 0.001, 0.5, 2.0)
    # [1] Speeds in each direction, from 2 % to 100 % of a joint's nominal speed.
    friction_speeds: int = 25
    # [1] Triangles of all meshes of an MJCF together.
    faces: int = 20_000
    # [1] Thickness of a mesh, relative to its size, below which MuJoCo refuses it.
    flat: float = 1e-5


TUNING = ExportTuning()
