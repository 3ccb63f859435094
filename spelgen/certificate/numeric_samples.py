"""Computations by Pinocchio for the verification of a structure: random samples, and a comparison with the URDF.

The samples are mass matrices, gravity torques and torque regressors at random configurations, computed from the chain
of bodies that spelgen has read from the URDF. Random inertial parameters are physically consistent: their
pseudo-inertia is positive definite (Wensing, Kim and Slotine, RA-L 3(1), 2018).

The samples cannot detect errors of spelgen's reading of the URDF. Therefore Pinocchio reads the URDF, too, and joint
axes, masses and inertias are compared with the chain. Pinocchio does not round angles: its values are compared with a
chain without rounding, and the effect of rounding is computed separately.
"""

import hashlib
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
import pinocchio as pin
from lxml import etree

from spelgen.arm.arm import Chain, make_arm
from spelgen.dynamics.constraint import mimic_constraint
from spelgen.dynamics.pinocchio_arm import arm_dynamics
from spelgen.dynamics.pinocchio_dynamics import PinocchioDynamics
from spelgen.settings.settings import Settings
from spelgen.structure.nominal import parameters_of
from spelgen.urdf.document import read_document
from spelgen.urdf.robot import Robot

ENGINE = f"Pinocchio {pin.__version__}"
TENSOR = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


@dataclass(frozen=True)
class NumericSamples:
    """Samples of M and of the gravity torque by Pinocchio at S random configurations.

    Attributes:
        mass: entries of the lower triangle of M, divided by ``scale``, (1 + n, S, n(n+1)/2) [1]. mass[0] is M at the S
            configurations; for mass[1 + k], coordinate k has another random position.
        scale: magnitude of each entry (i, j): sqrt(mean M_ii * mean M_jj), with means over the samples, (n(n+1)/2,).
        gravity: gravity torque dV/dq, divided by its largest magnitude, (S, n) [1].
        changes: changes of M / scale due to a change of one coordinate, (n, S, n(n+1)/2): mass[1:] - mass[0].
    """

    mass: np.ndarray
    scale: np.ndarray
    gravity: np.ndarray
    changes: np.ndarray


def draw(arm: Chain, count: int, rng: np.random.Generator, *, random_inertials: bool) -> NumericSamples:
    """Return samples of M and of the gravity torque at random configurations.

    Args:
        arm: the arm.
        count: number of configurations.
        rng: generator of the random configurations and inertial parameters.
        random_inertials: True: each sample has other random inertial parameters. False: all samples have the inertial
            parameters of the URDF.
    """
    n = len(arm.coordinates)
    rows, columns = np.tril_indices(n)
    mass = np.zeros((1 + n, count, n, n))
    gravity = np.zeros((count, n))
    for sample in range(count):
        dynamics = arm_dynamics(with_random_inertias(arm, rng) if random_inertials else arm, Settings())
        # Row 0 of q, (1 + n, n), has random positions. Row 1 + k differs from row 0 in coordinate k only, so that the
        # difference of M between both rows is an effect of coordinate k.
        base, moved = _positions(arm, rng), _positions(arm, rng)
        q = np.where(np.eye(1 + n, n, -1) == 1, moved, base)
        mass[:, sample] = dynamics.mass_matrix(q)
        gravity[sample] = dynamics.gravity(base)
    # Entries of M have different units (kg, kg m, kg m^2), and are therefore divided by scales with the same units.
    diagonal = np.abs(np.diagonal(mass, axis1=2, axis2=3)).mean(axis=(0, 1))
    scale = np.sqrt(np.outer(diagonal, diagonal))[rows, columns]
    scale[scale == 0] = 1.0
    # Gravity torques are divided by their largest magnitude, but by 1 if all are zero (no gravity), to avoid 0 / 0.
    largest = np.abs(gravity).max() or 1.0
    mass = mass[:, :, rows, columns] / scale
    return NumericSamples(mass, scale, gravity / largest, mass[1:] - mass[0])


def regressor(arm: Chain, rng: np.random.Generator) -> np.ndarray:
    """Return the torque regressor of n coordinates and B bodies at m random states (q, qd, qdd), (m n, 10 B).

    Its rank is the number of base parameters.
    """
    # The regressor does not depend on inertial parameters, but Pinocchio needs some values: random ones are used.
    dynamics = arm_dynamics(with_random_inertias(arm, rng), Settings())
    n, bodies = len(arm.coordinates), len(arm.bodies)
    rows = []
    # The regressor has more rows than columns, so that the number of samples does not limit its rank.
    for _ in range(10 * bodies // n + 10):
        q = dynamics.configuration(_positions(arm, rng))
        qd = dynamics.jacobian @ rng.normal(size=n)
        qdd = dynamics.jacobian @ rng.normal(size=n)
        by_joint = pin.computeJointTorqueRegressor(dynamics.model, dynamics.data, q, qd, qdd)
        # For a single joint Pinocchio returns a vector in place of a matrix: it is reshaped.
        rows.append(dynamics.jacobian.T @ by_joint.reshape(bodies, -1))
    return np.concatenate(rows)


def _positions(arm: Chain, rng: np.random.Generator) -> np.ndarray:
    """Return random joint positions, (n,): in [-pi, pi] rad for revolute, in [-1, 1] m for prismatic joints."""
    # Joint limits are not used, because the structure is valid at every configuration.
    half_range = np.where(np.array(arm.joint_types) == "revolute", np.pi, 1.0)
    return rng.uniform(-half_range, half_range)


def with_random_inertias(arm: Chain, rng: np.random.Generator) -> Chain:
    """Return the arm with random, physically consistent inertial parameters of all bodies."""
    translations = np.array([body.translation for body in arm.bodies], dtype=float)
    size = float(np.linalg.norm(translations, axis=1).mean()) or 1.0
    # For random matrices A (`factors`), A A^T are positive definite pseudo-inertias. Centres of mass and radii of
    # gyration have the magnitude of the distances between joints.
    factors = rng.normal(size=(len(arm.bodies), 4, 4)) * np.array([[size], [size], [size], [1.0]])
    bodies = []
    for body, inertia in zip(arm.bodies, parameters_of(factors @ factors.mT).tolist(), strict=True):
        bodies.append(replace(body, inertia=tuple(map(Fraction, inertia))))
    return replace(arm, bodies=tuple(bodies))


def differences_of_reading(robot: Robot, arm: Chain, seed: int) -> dict[str, tuple[float, float]]:
    """Return two relative differences between readings of the URDF per quantity: {quantity: (first, second)}.

    The quantities are "axes of the joints" (twists) and "masses and inertias" (M and gravity torques at random
    positions, because M contains all masses and inertias). The first number is the largest difference between Pinocchio
    and spelgen without rounding of angles, such as 1.5708 to pi/2. The second number is the largest difference between
    spelgen with and without rounding. Both are relative to the values without rounding. Raises the exceptions of
    Pinocchio, and ValueError if the file has changed or if a mass is negative.

    robot: the URDF. arm: the chain that spelgen has derived from it. seed: seed of the random positions.
    """
    dynamics = _pinocchio_dynamics(robot, arm)
    q = np.random.default_rng(seed).uniform(-1.0, 1.0, (6, len(arm.coordinates)))
    gravity = tuple(map(float, arm.gravity))
    as_written = make_arm(robot, joints=arm.joint_names, angle_tolerance=0.0, gravity=gravity)
    theirs = _compared_values(dynamics, arm, q)
    written, ours = (_compared_values(_arm_dynamics(variant), arm, q) for variant in (as_written, arm))
    if all(body.inertia is None for body in arm.bodies):
        del written["masses and inertias"]
    differences = {}
    for quantity, values in written.items():
        # Each element of a difference is divided by the largest magnitude of this element over the samples, so that
        # errors of light bodies are detected. A thousandth of the largest magnitude of all elements is added to the
        # divisor, so that rounding errors of elements close to zero are not reported.
        scale = np.abs(values).max(axis=0) + (1e-3 * np.abs(values).max() or 1.0)
        difference, rounding = (np.abs(samples[quantity] - values) / scale for samples in (theirs, ours))
        differences[quantity] = float(difference.max()), float(rounding.max())
    return differences


def _pinocchio_dynamics(robot: Robot, arm: Chain) -> PinocchioDynamics:
    """Return the dynamics of the arm, computed by Pinocchio from the URDF file of `robot`.

    Raises ValueError if the file has changed since `robot` was read, or if a link has a negative mass, which Pinocchio
    would replace by another value.
    """
    if any(link.inertial is not None and link.inertial.mass < 0 for link in robot.links):
        raise ValueError("negative mass of a link")
    document = read_document(robot.path)
    if hashlib.sha256(document.data).hexdigest() != robot.digest:
        raise ValueError("the file has changed since it was read")
    root = document.root
    # Limits and friction in the URDF are replaced, because they are not compared, and Pinocchio rejects some values.
    for element in [*root.iter("limit"), *root.iter("dynamics")]:
        element.getparent().remove(element)
    for joint in root.iterfind("joint"):
        etree.SubElement(joint, "limit", lower="-1", upper="1", effort="1", velocity="1")
    for inertial in root.iterfind("link/inertial[mass]"):
        if inertial.find("inertia") is None:
            etree.SubElement(inertial, "inertia", dict.fromkeys(TENSOR, "0"))
    model = pin.buildModelFromXML(etree.tostring(root, encoding="unicode"))
    model.gravity.linear = np.array(arm.gravity, dtype=float)
    return PinocchioDynamics(model, mimic_constraint(robot, arm.joint_names))


def _arm_dynamics(arm: Chain) -> PinocchioDynamics:
    bodies = []
    for body in arm.bodies:
        # Pinocchio reads a body without <inertial> as massless, so the body has zero mass in the chain, too.
        bodies.append(replace(body, inertia=body.inertia or (Fraction(0),) * 10))
    return arm_dynamics(replace(arm, bodies=tuple(bodies)), Settings())


def _compared_values(dynamics: PinocchioDynamics, arm: Chain, q: np.ndarray) -> dict[str, np.ndarray]:
    """Return two quantities by which Pinocchio's and spelgen's model of an arm are compared, at S positions q, (S, n).

    "axes of the joints", (S, 6, B): twists of the joints for unit velocities, in the root frame. "masses and inertias",
    (S, B, B + 1): M of the joints of the B moving bodies, which are the n coordinates and the mimic joints as
    independent joints; the last column is the gravity torque. The diagonal entries of M are doubled, in both models.
    Differences are compared relative to the magnitude of the same entry, so the factor of 2 cancels.

    dynamics: one of the two models. arm: chain with the names of the bodies.
    """
    model, data = dynamics.model, dynamics.data
    columns = [model.joints[model.getJointId(body.name)].idx_v for body in arm.bodies]
    axes, loads = [], []
    for configuration in dynamics.configuration(q):
        # For a single joint Pinocchio returns a vector in place of a matrix: it is reshaped.
        axes.append(pin.computeJointJacobians(model, data, configuration).reshape(6, -1)[:, columns])
        # Pinocchio computes only the upper triangle of M. The sum of both triangles doubles the diagonal entries, in
        # both models that are compared (see the docstring): this is not corrected.
        upper = np.triu(pin.crba(model, data, configuration))
        mass = upper + upper.T
        gravity = pin.computeGeneralizedGravity(model, data, configuration)
        loads.append(np.column_stack([mass, gravity])[columns][:, [*columns, -1]])
    return {"axes of the joints": np.array(axes), "masses and inertias": np.array(loads)}
