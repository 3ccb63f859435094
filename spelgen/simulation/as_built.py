"""The arm as it was built: a robot that differs from its URDF as real robots do, drawn from a seed.

Inertials are perturbed; the drives have armature, viscous friction, Coulomb friction that depends on the direction, and
presliding hysteresis. The result is a URDF with a settings file beside it: the ground truth of simulated logs.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml

from spelgen.arm.configured_arm import ConfiguredArm, load_arm
from spelgen.dynamics.pinocchio_arm import arm_dynamics
from spelgen.errors import SpelgenError
from spelgen.excitation.trajectory import SPEEDS, motion_bounds
from spelgen.files import write_bytes, write_text
from spelgen.simulation.perturbed_urdf import perturbed_urdf
from spelgen.simulation.tuning import AS_BUILT

ABOUT = "The arm as built, from seed {}: the ground truth of simulated logs. `spelgen simulate` on it makes more logs."


def as_built(arm: ConfiguredArm, seed: int, path: Path | str) -> ConfiguredArm:
    """Write the URDF and the settings of an arm as it may have been built, and return that arm.

    The arm can be simulated, and `evaluate` compares mass matrices with it. Raises ArmError if a moving link has no
    inertial, or if a joint has no room between its limits.

    Args:
        arm: The arm by its URDF.
        seed: Seed of all random numbers; the same seed gives the same files.
        path: The URDF to write; the settings go to the same name with .yaml.
    """
    path = Path(path)
    if path.resolve() == arm.robot.path.resolve():
        raise SpelgenError(
            "the URDF of the arm itself", file=path, expected="another file for the arm as built"
        )
    arm_dynamics(arm.arm, arm.settings)  # complains of missing inertials under the name of the user's file
    settings, sidecar = _settings(arm, seed), path.with_suffix(".yaml")
    write_bytes(path, perturbed_urdf(arm.robot.path, AS_BUILT.inertial_error, seed))
    # magnitudes of friction and armature follow from the perturbed rigid bodies, without drives
    write_text(sidecar, _yaml(settings))
    bodies = load_arm(path, angle_tolerance=arm.angle_tolerance)
    settings["joints"] = _drives(arm, bodies, np.random.default_rng([seed, 1]))
    write_text(sidecar, _yaml(settings))
    return load_arm(path, angle_tolerance=arm.angle_tolerance)


def _settings(arm: ConfiguredArm, seed: int) -> dict[str, object]:
    """Return the settings of the arm as built, without drives: how it is mounted, wired and moved."""
    given = arm.settings
    own = given.model_dump(
        mode="json",
        include={"gravity", "input", "torque", "couplings", "simulation", "tracking"},
        exclude_unset=True,
    )
    names = list(arm.arm.joint_names)
    settings: dict[str, object] = {"about": ABOUT.format(seed), "moving_joints": names} | own
    # a joint without a motor cannot be moved along a path: such an arm is driven as its own settings state
    if given.input == "position" or any(joint.passive for joint in arm.arm.coordinates):
        settings["simulation"] = own.get("simulation", {}) | {"seed": seed}
        return settings
    bounds = motion_bounds(arm.arm, 1.0, 1.0, arm.robot.joint)
    ranges = np.stack([bounds.low, bounds.high], axis=1).tolist()
    settings["simulation"] = {
        "protocol": "prescribed",
        "trajectories": 2,
        "duration": AS_BUILT.duration,
        "sample_rate": AS_BUILT.sample_rate,
        "test_fraction": 0.5,
        "presliding": AS_BUILT.presliding,
        "torque_noise": AS_BUILT.torque_noise,
        "positions": dict(zip(names, ranges, strict=True)) | own.get("simulation", {}).get("positions", {}),
        "seed": seed,
    }
    settings["tracking"] = {"paths": "excitation", "resolution": AS_BUILT.resolution}
    return settings


def _drives(
    arm: ConfiguredArm, bodies: ConfiguredArm, rng: np.random.Generator
) -> dict[str, dict[str, object]]:
    """Return random friction and armature of each joint, as settings.

    Coulomb friction is a fraction of the rigid-body torque of moderate motion (at most half the effort limit), armature
    a fraction of the mean diagonal entry of M.

    Args:
        arm: The arm by its URDF, whose gears and servo gains are kept.
        bodies: The arm as built, without drives.
        rng: Source of the random numbers.
    """
    joints = bodies.arm.coordinates
    bounds = motion_bounds(bodies.arm, AS_BUILT.range_fraction, 1.0)
    q = rng.uniform(bounds.low, bounds.high, (AS_BUILT.positions, len(joints)))
    dynamics = arm_dynamics(bodies.arm, bodies.settings)
    inertia = np.einsum("tii->i", dynamics.mass_matrix(q)) / len(q)
    speed = np.array([min(joint.velocity or np.inf, SPEEDS[joint.kind]) for joint in joints])
    torque = np.hypot(
        np.sqrt(np.square(dynamics.gravity(q)).mean(axis=0)), AS_BUILT.acceleration * speed * inertia
    )
    torque = np.minimum(torque, [joint.effort / 2 if joint.effort else np.inf for joint in joints])
    coulomb = rng.uniform(*AS_BUILT.coulomb, len(joints)) * torque
    asymmetry = rng.uniform(-AS_BUILT.asymmetry, AS_BUILT.asymmetry, len(joints))
    viscous = rng.uniform(*AS_BUILT.viscous, len(joints)) * coulomb / speed
    armature = rng.uniform(*AS_BUILT.armature, len(joints)) * inertia
    drives: dict[str, dict[str, object]] = {}
    for k, joint in enumerate(joints):
        given = arm.settings.joint(joint.name)
        kept = given.model_dump(mode="json", include={"gear", "actuated", "kp", "inputs"}, exclude_none=True)
        drives[joint.name] = kept | {
            "rotor_inertia": _rounded(armature[k] / given.gear**2),
            "viscous": _rounded(viscous[k]),
            "coulomb": [
                _rounded(coulomb[k] * (1 + asymmetry[k])),
                _rounded(-coulomb[k] * (1 - asymmetry[k])),
            ],
        }
    return drives


def _rounded(value: float) -> float:
    """Return a number with six significant digits."""
    return float(f"{value:.6g}")


def _yaml(settings: dict[str, object]) -> str:
    text: str = yaml.safe_dump(settings, sort_keys=False, allow_unicode=True)
    return text
