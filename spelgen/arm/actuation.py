"""Input matrix G of M qdd + ... = G tau, from the transmissions of the URDF and the settings.

Logs contain joint torques, or motor torques if the settings specify ``torque: motor``; G then contains gear ratios and
the couplings of wrists.
"""

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
    """A nonzero entry of G, with indices from 0.

    ``fixed``: a known gear; ``coupled``: known, of a motor that moves several joints; ``gain``: trained, with the
    initial value ``value``.
    """

    row: int
    column: int
    kind: InputKind
    value: float


class Drives(NamedTuple):
    """Matrices (n, n) of the motors of n joints.

    inputs: G, the joint torques are G times the logged torques. speeds: C, the motors rotate at C qd in units of the
    joints; friction and rotor inertia act at these speeds (see `motor_speeds`).
    """

    inputs: np.ndarray
    speeds: np.ndarray


@dataclass(frozen=True)
class Actuation:
    """The entries of G for n joints, and diagnostics.

    couplings: torque of a joint per motor torque, for coupled motors of a robot whose logs contain joint torques.
    """

    joints: int
    entries: tuple[InputEntry, ...]
    diagnostics: tuple[Diagnostic, ...] = ()
    couplings: tuple[InputEntry, ...] = ()

    @property
    def direct(self) -> bool:
        """Whether G is the identity for all joints with a drive."""
        return all(entry == InputEntry(entry.row, entry.row, "fixed", 1.0) for entry in self.entries)

    def matrix(self) -> np.ndarray:
        """Return G (n, n), with trained gains at their initial values."""
        result = np.zeros((self.joints, self.joints))
        for entry in self.entries:
            result[entry.row, entry.column] = entry.value
        return result

    def drives(self) -> Drives:
        """Return the input matrix G, (n, n), and the motor speeds C per joint velocity, (n, n)."""
        torques = self.matrix()
        for coupling in self.couplings:
            torques[coupling.row] = 0.0  # the logged torque acts at the joint, not at its motors
        for coupling in self.couplings:
            torques[coupling.row, coupling.column] = coupling.value
        return Drives(self.matrix(), motor_speeds(torques))


def motor_speeds(inputs: np.ndarray) -> np.ndarray:
    """Return C, with which the motors rotate at C qd.

    Args:
        inputs: joint torques per motor torque, (n, n).

    Returns:
        C (n, n). The speed of a motor is in units of the joint with its largest torque: C is the identity if each motor
        moves only its own joint. A joint without motor has the row of the identity.
    """
    # Equal power, tau_m . speed_m = tau . qd with tau = G tau_m, gives C = G^T, up to the scales of the motors.
    largest = np.take_along_axis(inputs, np.abs(inputs).argmax(axis=0)[None], axis=0)
    passive = largest == 0
    speeds: np.ndarray = (inputs / np.where(passive, 1.0, largest)).T + np.diag(passive[0].astype(float))
    return speeds


def derive_actuation(robot: Robot, settings: Settings, joints: Sequence[str]) -> Actuation:
    """Return G of the arm with these ``joints``.

    Raises SettingsError for couplings with locked joints, UrdfError for a required transmission with unusable numbers.
    """
    # the row of a passive joint is zero
    driven = [name for name in joints if settings.joint(name).actuated]
    remarks = tuple(_undriven(robot, settings, driven))
    couplings = tuple(_couplings(robot, settings, joints))
    if settings.torque == "joint":
        direct = [InputEntry(k, k, "fixed", 1.0) for k, name in enumerate(joints) if name in driven]
        return Actuation(len(joints), tuple(direct), remarks, couplings)
    coupled = {entry.row for entry in couplings}
    # G is known for coupled joints, and a gear of their own would count twice
    geared = [
        _geared(robot, settings, name, k)
        for k, name in enumerate(joints)
        if name in driven and k not in coupled
    ]
    entries = sorted([*couplings, *geared], key=lambda entry: (entry.row, entry.column))
    return Actuation(len(joints), tuple(entries), remarks)


def _undriven(robot: Robot, settings: Settings, driven: Sequence[str]) -> Iterator[Diagnostic]:
    """Yield a remark for each joint without transmission if other joints have one: it may be a passive joint."""
    transmitted = {name for transmission in robot.transmissions for name in transmission.joint_names}
    # most URDFs have no transmissions
    if transmitted.isdisjoint(driven):
        return
    for name in driven:
        if name not in transmitted and name not in settings.joints:
            message = "no transmission drives it, others have one: taken as driven (otherwise write actuated: false)"
            yield Diagnostic("info", "no-transmission", f"joint {name!r}", robot.joint[name].line, message)


def _geared(robot: Robot, settings: Settings, name: str, index: int) -> InputEntry:
    """Return the entry of a motor and its joint: the gear of the settings, else of the URDF, else a trained gain."""
    joint = settings.joint(name)
    gear = joint.gear if "gear" in joint.model_fields_set else _reduction(robot, name)
    # an unknown gain is trained, not assumed to be 1
    if gear is None:
        return InputEntry(index, index, "gain", 1.0)
    return InputEntry(index, index, "gain" if joint.gain == "trained" else "fixed", gear)


def _reduction(robot: Robot, name: str) -> float | None:
    """Return the reduction of the simple transmission of a joint; None if the URDF has none, or 0."""
    for transmission in robot.transmissions:
        if _SIMPLE in transmission.type and transmission.joint_names == [name]:
            collect(transmission.errors)
            reductions = [reduction for _, reduction in transmission.actuators if reduction]
            # URDF does not specify the distribution of the load on two actuators of a joint
            if len(reductions) == 1:
                return reductions[0]
    return None


def _couplings(robot: Robot, settings: Settings, joints: Sequence[str]) -> list[InputEntry]:
    """Return the couplings of the settings, then the differential transmissions of the URDF for all other joints."""
    entries: list[InputEntry] = []
    free = set(joints)
    errors = []
    for coupling in settings.couplings:
        locked = [name for name in coupling.joints if name not in joints]
        # a coupling of only locked joints belongs to another part of the robot
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
        # for logged joint torques an unusable transmission is not needed
        if is_pair and free.issuperset(names) and not (transmission.errors and settings.torque == "joint"):
            collect(transmission.errors)
            entries += _block(joints, names, _differential(transmission))
            free.difference_update(names)
    return entries


def _differential(transmission: Transmission) -> tuple[tuple[float, float], ...]:
    """Return the torques of two joints per torque of two motors, each of which moves both joints.

    Source: ROS transmission_interface, DifferentialTransmission. An absent reduction, or 0, counts as 1.
    """
    first, second = (reduction or 1.0 for _, reduction, _ in transmission.joints)
    a, b = (reduction or 1.0 for _, reduction in transmission.actuators)
    return ((first * a, first * b), (second * a, -second * b))


def _block(
    joints: Sequence[str], names: Sequence[str], matrix: Sequence[Sequence[float]]
) -> Iterator[InputEntry]:
    """Yield the nonzero entries of ``matrix``, the block of G of the joints ``names``."""
    for row, values in zip(names, matrix, strict=True):
        for column, value in zip(names, values, strict=True):
            if value:
                yield InputEntry(joints.index(row), joints.index(column), "coupled", value)
