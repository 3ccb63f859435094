"""--to urdf: the arm's own files with the learned numbers in them, and the friction that no URDF has words for."""

from __future__ import annotations

import numpy as np
import yaml

from spelgen.dynamics.residuals import friction_factor
from spelgen.exporting.describe import array
from spelgen.exporting.exported import UNITS, Exported, readme
from spelgen.exporting.rigid_body_projection import (
    RigidBodyProjection,
    rigid_body_projection,
    sampled_positions,
)
from spelgen.exporting.trained import Trained
from spelgen.exporting.urdf_file import rounded, settings_text, urdf_text

_LAW = (
    "viscous qd + saturation turned(qd, saturation_velocity) + dry direction, with "
    "dry = coulomb + stribeck / (1 + (1 + r) v^2 / (v + r) / 8)^8 + "
    "load_dependence sqrt(gravity torque^2 + least_load^2), v = |qd| / stribeck_velocity, r = stribeck_rounding "
    "and turned(x, width) = x / sqrt(x^2 + width^2); direction: memoryless turned(qd, coulomb_smoothing_velocity) "
    "plus the sum of bristle_fractions z / bristle_reach, with z' = qd up to |z| = bristle_reach; "
    "all of it times a factor that goes with the joint's position, between the two numbers of "
    "position_factor, or one where there are none"
)
_SERVO = (
    "clip(kp d - kd qd, -limit, limit), d what u - q is beyond the dead zone, u commanded `delay` [s] before"
)


def export_urdf(trained: Trained) -> Exported:
    """Return the URDF, its settings, and the friction of a trained model."""
    projection = rigid_body_projection(trained.model, trained.arm)
    use = (
        "The .urdf contains inertials, viscous and Coulomb friction, which simulators ignore; the .yaml beside it, "
        "which spelgen reads, rotor inertia and friction in both directions; .urdf.friction.yaml the model's own law."
    )
    about = f"{UNITS}; inertials of a body stand with the link that its joint moves."
    title, checked = f"{trained.robot} as a URDF", f"{'; '.join(projection.summary)}."
    files = {
        ".urdf": urdf_text(projection),
        ".yaml": settings_text(projection).encode(),
        ".urdf.friction.yaml": _friction_text(trained, projection).encode(),
        ".urdf.README.md": readme(title, use, trained.joint_names, about, checked),
    }
    return Exported("urdf", trained.robot, files, projection.summary)


def _friction_text(trained: Trained, projection: RigidBodyProjection) -> str:
    """Return YAML: viscous and Coulomb friction of each joint, and its own law and servo where the model has one."""
    content: dict[str, object] = {
        "units": "Nm, Nm s/rad and rad/s of revolute joints; N, N s/m and m/s of prismatic ones",
        "viscous_coulomb": "viscous qd + coulomb[0] where qd > 0, + coulomb[1] where qd < 0",
    }
    coulomb = np.stack([projection.friction.forward, projection.friction.backward], axis=1)
    # by section and name, (n, ...) each
    sections = {"viscous_coulomb": {"viscous": projection.friction.viscous, "coulomb": coulomb}}
    # networks have no law with constants
    if projection.own:
        content["law"] = _LAW
        sections["law"] = _law_constants(trained, projection)
    servos = projection.servos
    if servos is not None:
        content |= {"servo": _SERVO, "delay": rounded(servos.delay)}
        gains = {"kp": servos.kp, "kd": servos.kd, "limit": servos.limit, "dead_zone": servos.dead_zone}
        sections["servo"] = gains
    joints: dict[str, dict[str, object]] = {}
    for index, name in enumerate(trained.joint_names):
        joints[name] = {}
        for section, constants in sections.items():
            joints[name][section] = {key: _plain(values[index]) for key, values in constants.items()}
    content["joints"] = joints
    text: str = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
    return text


def _law_constants(trained: Trained, projection: RigidBodyProjection) -> dict[str, np.ndarray]:
    """Return the constants of the model's own law of friction by name, (n, ...) each."""
    model = trained.model
    constants = {name: array(value) for name, value in model.friction.prepare()._asdict().items()}
    factor = array(friction_factor(model, sampled_positions(projection.arm.arm)))
    if (factor != 1).any():
        constants["position_factor"] = np.stack([factor.min(axis=0), factor.max(axis=0)], axis=-1)
    return constants


def _plain(value: np.ndarray) -> float | list[float]:
    """Return a number, or a row of numbers, for YAML."""
    if value.ndim == 0:
        return rounded(float(value))
    return list(map(rounded, value.tolist()))
