"""Input matrix G of the equation of motion, from the transmissions of the URDF and the settings.

G converts logged torques tau to joint torques: M qdd + ... = G tau. G is the identity if joint torques are logged. If
the settings specify ``torque: motor``, motor torques are logged, and G contains the gear ratios and the couplings of
motors that drive several joints, as in many wrists.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from spelgen.errors import Diagnostic, SettingsError, collect
from spelgen.settings.settings import Settings
from spelgen.urdf.robot import Robot, Transmission

InputKind = Literal["fixed", "gain", "coupled"]
_SIMPLE, _DIFFERENTIAL = "SimpleTransmission", "DifferentialTransmission"


@dataclass(frozen=True)
class InputEntry:
    """A nonzero entry of the input matrix G, joint torques per logged torque; row and column are 0-based.

    ``kind``: ``fixed``: known gear of a motor that moves one joint; ``coupled``: known entry of a motor that moves
    several joints; ``gain``: trained entry, with the initial value ``value``.
    """

    row: int
    column: int
    kind: InputKind
    value: float


class Drives(NamedTuple):
    """Matrices (n, n) of the motors of n joints.

    Attributes:
        inputs: the input matrix G; the joint torques are G times the logged torques.
        speeds: the matrix C; the motor speeds, measured on the output side of the gears, are C qd (see `motor_speeds`).
            Friction and rotor inertia act at the motor speeds.
    """

    inputs: np.ndarray
    speeds: np.ndarray

    @classmethod
    def direct(cls, joints: int) -> Drives:
        """Return the matrices of motors that move only their own joints: two identity matrices."""
        return cls(np.eye(joints), np.eye(joints))


@dataclass(frozen=True)
class Actuation:
    """Nonzero entries of the input matrix G (n, n) of an arm, joint torques per logged torque, and diagnostics.

    Motors are coupled if several of them drive the same joints, as in a differential.

    - Logs with motor torques: ``entries`` has the entries of all motors, joint torque per motor torque, and
      ``couplings`` is empty.
    - Logs with joint torques: ``entries`` has a 1 on the diagonal of G for each driven joint. ``couplings`` has the
      joint torques per motor torque of coupled motors. The torques of the model do not depend on ``couplings``, but
      `drives` computes the motor speeds from them.

    joints: number n of joints.
    """

    joints: int
    entries: tuple[InputEntry, ...]
    diagnostics: tuple[Diagnostic, ...] = ()
    couplings: tuple[InputEntry, ...] = ()

    @property
    def direct(self) -> bool:
        """Whether the input matrix G is the identity, except for zero rows of passive joints."""
        return all(entry == InputEntry(entry.row, entry.row, "fixed", 1.0) for entry in self.entries)

    def matrix(self) -> np.ndarray:
        """Return the input matrix G (n, n), joint torques per logged torque, with initial values of trained gains."""
        result = np.zeros((self.joints, self.joints))
        for entry in self.entries:
            result[entry.row, entry.column] = entry.value
        return result

    def drives(self) -> Drives:
        """Return G (n, n), joint torques per logged torque, and C (n, n), motor speeds per joint velocity."""
        torques = self.matrix()
        # With logged joint torques, the input matrix G is the identity for coupled joints, but the motor speeds depend
        # on the couplings (joint torques per motor torque). `torques` is therefore a copy of G in which the rows of
        # coupled joints are replaced by the couplings. Its transpose gives the motor speeds (see `motor_speeds`).
        for coupling in self.couplings:
            torques[coupling.row] = 0.0
        for coupling in self.couplings:
            torques[coupling.row, coupling.column] = coupling.value
        return Drives(self.matrix(), motor_speeds(torques))


def motor_speeds(inputs: np.ndarray) -> np.ndarray:
    """Return the matrix C of the motor speeds C qd at the joint velocities qd.

    Args:
        inputs: matrix G of joint torques per motor torque, (n, n).

    Returns:
        C (n, n), row i for motor i: G^T with each row divided by its element of largest magnitude. This element is the
        gear ratio of motor i to the joint on which it has the largest torque. C is the identity if each motor moves
        only its own joint. The row of a passive joint, which has no motor, is the row of the identity.
    """
    # Motors and joints have equal power: tau_m . speed_m = tau . qd, and tau = G tau_m, so that the motor speeds are
    # speed_m = G^T qd. Each row of G^T is divided by its element of largest magnitude: friction is then a function of
    # the speed on the joint side of the gear.
    largest = np.take_along_axis(inputs, np.abs(inputs).argmax(axis=0)[None], axis=0)
    passive = largest == 0
    return (inputs / np.where(passive, 1.0, largest)).T + np.diag(passive[0].astype(float))


def derive_actuation(robot: Robot, settings: Settings, joints: Sequence[str]) -> Actuation:
    """Return the nonzero entries of the input matrix G of an arm, with diagnostics.

    joints: names of the moving joints, which are the coordinates of the arm. Raises SettingsError for a coupling of a
    moving and a locked joint. Raises UrdfError if the numbers of a differential transmission are unusable and the logs
    contain motor torques.
    """
    # Only driven joints have entries of the input matrix G: the row of a passive joint is zero.
    driven = [name for name in joints if settings.joint(name).actuated]
    remarks = (*_undriven(robot, settings, driven), *_reduced(robot, settings, driven))
    couplings = tuple(_couplings(robot, settings, joints))
    if settings.torque == "joint":
        direct = [InputEntry(k, k, "fixed", 1.0) for k, name in enumerate(joints) if name in driven]
        return Actuation(len(joints), tuple(direct), remarks, couplings)
    coupled = {entry.row for entry in couplings}
    # Joints of coupled motors are omitted here: their entries of G, which include the gear ratios, are in `couplings`.
    geared = [
        _geared(robot, settings, name, k)
        for k, name in enumerate(joints)
        if name in driven and k not in coupled
    ]
    entries = sorted([*couplings, *geared], key=lambda entry: (entry.row, entry.column))
    return Actuation(len(joints), tuple(entries), remarks)


def _undriven(robot: Robot, settings: Settings, driven: Sequence[str]) -> Iterator[Diagnostic]:
    """Yield a remark for each joint without transmission if other joints have one; such a joint may be passive.

    driven: names of the joints that are not passive in the settings.
    """
    transmitted = {name for transmission in robot.transmissions for name in transmission.joint_names}
    # A URDF without transmissions causes no remarks: most URDFs have none.
    if transmitted.isdisjoint(driven):
        return
    for name in driven:
        if name not in transmitted and name not in settings.joints:
            message = "no transmission drives it, others have one: taken as driven (otherwise write actuated: false)"
            yield Diagnostic("info", "no-transmission", f"joint {name!r}", robot.joint[name].line, message)


def _reduced(robot: Robot, settings: Settings, driven: Sequence[str]) -> Iterator[Diagnostic]:
    """Yield a remark if the URDF states reductions of driven joints, and the settings do not state a `torque`.

    Text of the remark: the logged torques are assumed to be joint torques; motor torques must be declared in the
    settings. driven: names of the joints that are not passive in the settings.
    """
    transmissions = [x for x in robot.transmissions if not x.errors and set(x.joint_names) <= set(driven)]
    reductions = {
        name: reduction
        for transmission in transmissions
        for name in transmission.joint_names
        if abs(reduction := _reduction(robot, name) or 1.0) != 1.0
    }
    if reductions and "torque" not in settings.model_fields_set:
        stated = ", ".join(f"{name} {reduction:g}" for name, reduction in reductions.items())
        message = (
            f"reductions of transmissions ({stated}): logged torques are taken as joint torques; write "
            "'torque: motor' into the settings if they are torques of the motors"
        )
        yield Diagnostic("info", "reduction", "robot", None, message)


def _geared(robot: Robot, settings: Settings, name: str, index: int) -> InputEntry:
    """Return the entry of the input matrix G of a motor that moves only the joint ``name``, with the index ``index``.

    Its value is the gear in the settings, otherwise the reduction in the URDF. If both are absent, the entry is a
    trained gain with the initial value 1.
    """
    joint = settings.joint(name)
    gear = joint.gear if "gear" in joint.model_fields_set else _reduction(robot, name)
    # An unknown gear ratio is trained; 1 is only its initial value. A fixed ratio of 1 would be an assumption.
    if gear is None:
        return InputEntry(index, index, "gain", 1.0)
    return InputEntry(index, index, "gain" if joint.gain == "trained" else "fixed", gear)


def _reduction(robot: Robot, name: str) -> float | None:
    """Return the reduction of the transmission of a joint, of type SimpleTransmission; None if it is absent or 0."""
    for transmission in robot.transmissions:
        if _SIMPLE in transmission.type and transmission.joint_names == [name]:
            collect(transmission.errors)
            # ROS 1 states the reduction at the actuator, ros2_control at the joint.
            reductions = [x for x in transmission.actuators if x] or [x for _, x in transmission.joints if x]
            # A joint with two actuators has no known reduction: URDF does not specify how they share the load.
            if len(reductions) == 1:
                return reductions[0]
    return None


def _couplings(robot: Robot, settings: Settings, joints: Sequence[str]) -> list[InputEntry]:
    """Return the entries of the input matrix G of motors that drive several of the moving joints ``joints``.

    Couplings in the settings take precedence over differential transmissions in the URDF.
    """
    entries: list[InputEntry] = []
    free = set(joints)
    errors = []
    for coupling in settings.couplings:
        locked = [name for name in coupling.joints if name not in joints]
        # A coupling whose joints are all locked is skipped: it belongs to another arm of the robot.
        if len(locked) == len(coupling.joints):
            continue
        free.difference_update(coupling.joints)
        expected = f"joints of the arm: {', '.join(joints)}"
        for name in locked:
            got = f"the joint {name!r}, which is locked"
            errors.append(SettingsError(got, element="couplings", expected=expected))
        if not locked:
            entries += _block(joints, coupling.joints, coupling.matrix)
    collect(errors)
    for transmission in robot.transmissions:
        names = transmission.joint_names
        is_pair = _DIFFERENTIAL in transmission.type and len(names) == len(transmission.actuators) == 2
        # With logged joint torques, transmissions are not needed: an unusable transmission is ignored. With logged
        # motor torques, it is an error.
        if is_pair and free.issuperset(names) and not (transmission.errors and settings.torque == "joint"):
            collect(transmission.errors)
            entries += _block(joints, names, _differential(transmission))
            free.difference_update(names)
    return entries


def _differential(transmission: Transmission) -> tuple[tuple[float, float], ...]:
    """Return the matrix (2, 2) of joint torques (rows) per motor torque (columns) of a differential transmission.

    Source: ROS transmission_interface, DifferentialTransmission. A reduction that is absent or 0 is replaced by 1.
    """
    first, second = (reduction or 1.0 for _, reduction in transmission.joints)
    a, b = (reduction or 1.0 for reduction in transmission.actuators)
    return ((first * a, first * b), (second * a, -second * b))


def _block(
    joints: Sequence[str], names: Sequence[str], matrix: Sequence[Sequence[float]]
) -> Iterator[InputEntry]:
    """Yield the nonzero entries of a block of the input matrix G: ``matrix`` (k, k) couples the k joints ``names``.

    Row and column of an entry are positions in ``joints``, the names of all n joints.
    """
    for row, values in zip(names, matrix, strict=True):
        for column, value in zip(names, values, strict=True):
            if value:
                yield InputEntry(joints.index(row), joints.index(column), "coupled", value)
