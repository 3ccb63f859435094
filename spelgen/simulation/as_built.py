"""The arm as built: a random robot with realistic differences from its URDF.

Inertials are perturbed; the drives have armature, viscous friction, Coulomb friction that depends on the direction, and
presliding hysteresis. The result is a URDF with a settings file, which is the ground truth of simulated logs.
"""

from pathlib import Path

import numpy as np
import yaml
from lxml import etree

from spelgen.arm.configured_arm import Arm, load_arm
from spelgen.dynamics.pinocchio_arm import arm_dynamics, require_inertials
from spelgen.errors import SpelgenError
from spelgen.excitation.bounds import SPEEDS, motion_bounds
from spelgen.files import write_bytes, write_text
from spelgen.simulation.tuning import AS_BUILT
from spelgen.structure.nominal import parameters_of, pseudo_inertia
from spelgen.urdf.document import read_document

ABOUT = "The arm as built, from seed {}: the ground truth of simulated logs. `spelgen simulate` on it makes more logs."


def as_built(arm: Arm, seed: int, path: Path | str) -> Arm:
    """Write the URDF and the settings of a random arm with realistic differences from a nominal arm; return the arm.

    The arm can be simulated, and `evaluate` compares mass matrices with it. Raises ArmError if a moving link has no
    inertial, or if the limits of a joint are too close together for a motion.

    Args:
        arm: Nominal arm, as specified by its URDF.
        seed: Seed of all random numbers; the same seed gives the same files.
        path: The URDF to write; the settings go to the same name with .yaml.
    """
    path = Path(path)
    if path.resolve() == arm.robot.path.resolve():
        raise SpelgenError(
            "the URDF of the arm itself", file=path, expected="another file for the arm as built"
        )
    # Absent inertials are an error here already: the message names the user's URDF, and no file has been written.
    require_inertials(arm.chain, arm.robot.path)
    settings = _settings(arm, seed)
    write_bytes(path, perturbed_urdf(arm.robot.path, AS_BUILT.inertial_error, seed))
    # The scales of friction and armature are computed from the torques and M of the perturbed bodies. Therefore the arm
    # is written and read twice: first without drives, for these scales, then with drives.
    bodies = _with_settings(path, settings, arm)
    settings["joints"] = _drives(arm, bodies, np.random.default_rng([seed, 1]))
    return _with_settings(path, settings, arm)


def _with_settings(path: Path, settings: dict[str, object], arm: Arm) -> Arm:
    """Write `settings` next to the URDF `path`; return the arm that is loaded from both files.

    Angles of the URDF that differ from a multiple of pi/2 by less than the angle tolerance of ``arm`` are rounded to
    this multiple.
    """
    write_text(path.with_suffix(".yaml"), yaml.safe_dump(settings, sort_keys=False, allow_unicode=True))
    return load_arm(path, angle_tolerance=arm.angle_tolerance)


def _settings(arm: Arm, seed: int) -> dict[str, object]:
    """Return the settings of the random arm that `as_built` makes from ``arm``, without the drives (`joints`).

    Gravity, inputs and couplings are copied from ``arm``. seed: seed of simulated motions.
    """
    nominal = arm.settings
    carried = nominal.model_dump(
        mode="json",
        include={"gravity", "input", "torque", "couplings", "simulation", "tracking"},
        exclude_unset=True,
    )
    names = list(arm.chain.joint_names)
    settings = {"about": ABOUT.format(seed), "moving_joints": names} | carried
    # All arms are simulated along prescribed paths, except arms with position servos or passive joints: their motion
    # depends on the servos or on free joints and cannot be prescribed, so the simulation in their settings is kept.
    if nominal.input == "position" or any(joint.passive for joint in arm.chain.coordinates):
        settings["simulation"] = carried.get("simulation", {}) | {"seed": seed}
        return settings
    bounds = motion_bounds(arm.chain, 1.0, 1.0, arm.robot.joint)
    ranges = np.stack([bounds.low, bounds.high], axis=1).tolist()
    positions = dict(zip(names, ranges, strict=True)) | carried.get("simulation", {}).get("positions", {})
    settings["simulation"] = {
        "protocol": "prescribed",
        "trajectories": 2,
        "duration": AS_BUILT.duration,
        "sample_rate": AS_BUILT.sample_rate,
        "test_fraction": 0.5,
        "presliding": AS_BUILT.presliding,
        "torque_noise": AS_BUILT.torque_noise,
        "positions": positions,
        "seed": seed,
    }
    settings["tracking"] = {"paths": "excitation", "resolution": AS_BUILT.resolution}
    return settings


def _drives(arm: Arm, bodies: Arm, rng: np.random.Generator) -> dict[str, dict[str, object]]:
    """Return {name of a joint: settings} with random friction and armature.

    Coulomb friction is a random fraction of the smaller one of two torques: the typical rigid-body torque of the joint,
    and half of the joint's effort limit. Armature is a random fraction of the joint's diagonal entry of M, averaged
    over positions.

    Args:
        arm: Nominal arm, whose gear ratios and servo gains are kept.
        bodies: Random arm without drives.
        rng: Source of the random numbers.
    """
    joints = bodies.chain.coordinates
    bounds = motion_bounds(bodies.chain, AS_BUILT.range_fraction, 1.0)
    q = rng.uniform(bounds.low, bounds.high, (AS_BUILT.positions, len(joints)))
    dynamics = arm_dynamics(bodies.chain, bodies.settings)
    inertia = np.einsum("tii->i", dynamics.mass_matrix(q)) / len(q)
    speed = np.array([min(joint.velocity or np.inf, SPEEDS[joint.joint_type]) for joint in joints])
    # The typical rigid-body torque is the RMS of gravity torque plus inertia torque. The two torques are assumed to be
    # uncorrelated, so their mean squares are added.
    torque = np.hypot(
        np.sqrt(np.square(dynamics.gravity(q)).mean(axis=0)), AS_BUILT.acceleration * speed * inertia
    )
    torque = np.minimum(torque, [joint.effort / 2 if joint.effort else np.inf for joint in joints])
    coulomb = rng.uniform(*AS_BUILT.coulomb, len(joints)) * torque
    asymmetry = rng.uniform(-AS_BUILT.asymmetry, AS_BUILT.asymmetry, len(joints))
    viscous = rng.uniform(*AS_BUILT.viscous, len(joints)) * coulomb / speed
    armature = rng.uniform(*AS_BUILT.armature, len(joints)) * inertia
    drives = {}
    for k, joint in enumerate(joints):
        drive = arm.settings.joint(joint.name)
        forward, backward = coulomb[k] * (1 + asymmetry[k]), coulomb[k] * (1 - asymmetry[k])
        numbers = (armature[k] / drive.gear**2, viscous[k], forward, backward)
        rotor, damping, forward, backward = (float(f"{x:.6g}") for x in numbers)
        unchanged = drive.model_dump(
            mode="json", include={"gear", "actuated", "kp", "inputs"}, exclude_none=True
        )
        changed = {"rotor_inertia": rotor, "viscous": damping, "coulomb": [forward, -backward]}
        drives[joint.name] = unchanged | changed
    return drives


def perturbed_urdf(robot: Path, error: float, seed: int) -> bytes:
    """Return the URDF without friction, visuals and collisions, and with perturbed inertials.

    Each link has two independent random factors exp(error N(0, 1)): one scales the mass, the other the inertia about
    the centre of mass divided by the mass. The centre of mass is shifted by error N(0, 1) times the body's radius of
    gyration, along each axis of the link frame. Physically inconsistent inertia tensors are replaced by consistent
    ones.

    Args:
        robot: URDF or xacro file, which was read before.
        error: Relative standard deviation: 0.3 is 30 %.
        seed: Seed of the random factors; the same seed gives the same bytes.
    """
    root = urdf_without(robot, "dynamics", "visual", "collision")
    rng = np.random.default_rng(seed)
    for inertial in root.iterfind(".//link/inertial"):
        _perturb(inertial, error * rng.normal(size=2), error * rng.normal(size=3))
    return bytes(etree.tostring(root, xml_declaration=True, encoding="utf-8"))


def urdf_without(robot: Path, *tags: str) -> etree._Element:
    """Return the root element of a URDF or xacro file, without comments and without the elements named in `tags`."""
    root = read_document(robot).root
    etree.strip_tags(root, etree.Comment)
    etree.strip_elements(root, *tags)
    return root


def _perturb(inertial: etree._Element, log_factors: np.ndarray, displacement: np.ndarray) -> None:
    """Scale mass and inertia of an <inertial> and shift its centre of mass.

    Args:
        inertial: The element, changed in place.
        log_factors: Logarithms of two factors, (2,): of the mass, and of the inertia divided by the mass.
        displacement: Shift of the centre of mass divided by the radius of gyration, (3,) [1].
    """
    mass, tensor = inertial.find("mass"), inertial.find("inertia")
    if mass is None or float(mass.get("value", "0")) <= AS_BUILT.massless:
        return
    mass_factor, inertia_factor = np.exp(log_factors).tolist()
    kilograms, trace = float(mass.get("value")), 0.0
    mass.set("value", repr(mass_factor * kilograms))
    if tensor is not None:
        _make_consistent(tensor)
        trace = sum(float(tensor.get(name, "0")) for name in ("ixx", "iyy", "izz"))
        for name, value in tensor.attrib.items():
            tensor.set(name, repr(mass_factor * inertia_factor * float(value)))
    # The radius of gyration r is the RMS distance of the mass from its centre: m r^2 = trace(I) / 2.
    gyration_radius = np.sqrt(max(trace, 0.0) / 2 / kilograms)
    origin = inertial.find("origin")
    if origin is None:
        origin = etree.SubElement(inertial, "origin")
    center = np.array(origin.get("xyz", "0 0 0").split(), dtype=float)
    origin.set("xyz", " ".join(map(repr, (center + gyration_radius * displacement).tolist())))


def _make_consistent(tensor: etree._Element) -> None:
    """Replace an inertia tensor I that no body can have by a physically consistent tensor.

    A body has a positive semidefinite matrix of second moments of mass, S = trace(I) / 2 * identity - I (Wensing, Kim,
    Slotine, IEEE RA-L 3:60, 2018). Negative eigenvalues of S are replaced by small positive values.
    """
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    pseudo = pseudo_inertia(np.array([1.0, 0, 0, 0, *(float(tensor.get(name, "0")) for name in names)]))
    moments, axes = np.linalg.eigh(pseudo[:3, :3])
    largest = np.abs(moments).max()
    if moments.min() >= -1e-9 * largest:
        return
    pseudo[:3, :3] = (axes * np.maximum(moments, AS_BUILT.min_spread * largest)) @ axes.T
    for name, value in zip(names, parameters_of(pseudo)[4:].tolist(), strict=True):
        tensor.set(name, repr(value))
