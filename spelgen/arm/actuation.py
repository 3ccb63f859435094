"""Derive what the logs' torques do to the joints: the input matrix G of M qdd + ... = G tau, as the files say.

A log holds joint torques unless the sidecar says ``torque: motor``; then gears and coupled wrists stand between.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
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
    """Hold an entry of G that is not zero, 0-based.

    It is known (``fixed``, or ``coupled`` where one motor moves several joints), or a ``gain`` that is trained and
    starts at ``value``.
    """

    row: int
    column: int
    kind: InputKind
    value: float


class Drives(NamedTuple):
    """Hold matrices (n, n) of the motors of n joints.

    inputs: G, the joints' torques are G times what is logged. speeds: C, the motors' speeds are C qd, in units of the
    joints: friction and rotors belong to them (see `motor_speeds`).
    """

    inputs: np.ndarray
    speeds: np.ndarray


@dataclass(frozen=True)
class Actuation:
    """Hold G of n joints by its entries, and what there is to tell about it.

    couplings: joint torques by motor torques where what is logged is at the joints already, but motors move several.
    """

    joints: int
    entries: tuple[InputEntry, ...]
    diagnostics: tuple[Diagnostic, ...] = ()
    couplings: tuple[InputEntry, ...] = ()

    @property
    def direct(self) -> bool:
        """Whether every torque acts on its own joint as it is."""
        return all(entry == InputEntry(entry.row, entry.row, "fixed", 1.0) for entry in self.entries)

    def matrix(self) -> np.ndarray:
        """Return G (n, n), gains at their start."""
        return self._matrix(self.entries)

    def drives(self) -> Drives:
        """Return G, and how the motors turn."""
        torques = self.matrix()
        for coupling in self.couplings:
            torques[coupling.row] = 0.0  # the logs' torque is at the joint, its motors' are not
        torques += self._matrix(self.couplings)
        return Drives(self.matrix(), motor_speeds(torques))

    def _matrix(self, entries: Sequence[InputEntry]) -> np.ndarray:
        result = np.zeros((self.joints, self.joints))
        for entry in entries:
            result[entry.row, entry.column] = entry.value
        return result


def motor_speeds(inputs: np.ndarray) -> np.ndarray:
    """Return C, (n, n): the motors' speeds are C qd, where the joints' torques are ``inputs`` times the motors'.

    By the same power, each motor's in the units of the joint that it moves most: C is the identity where each moves
    its own joint alone. A joint without a motor stands for its own.
    """
    # power is the same on both sides: tau_m . speed_m = tau . qd makes C the transpose of G, up to units
    largest = np.take_along_axis(inputs, np.abs(inputs).argmax(axis=0)[None], axis=0)
    passive = largest == 0
    speeds: np.ndarray = (inputs / np.where(passive, 1.0, largest)).T + np.diag(passive[0].astype(float))
    return speeds


def derive_actuation(robot: Robot, settings: Settings, joints: Sequence[str]) -> Actuation:
    """Return G of the arm with these ``joints``.

    Raises SettingsError for couplings with locked joints, UrdfError for a transmission that is needed and
    has unusable numbers.
    """
    # the row of a passive joint stays zero: no torque of a log acts on it
    driven = [name for name in joints if settings.joint(name).actuated]
    remarks = tuple(_undriven(robot, settings, driven))
    couplings = _couplings(robot, settings, joints)
    if settings.torque == "joint":
        direct: list[InputEntry] = []
        for name in driven:
            direct.append(InputEntry(joints.index(name), joints.index(name), "fixed", 1.0))
        return Actuation(len(joints), tuple(direct), remarks, tuple(couplings))
    entries = list(couplings)
    coupled = {entry.row for entry in couplings}
    for name in driven:
        index = joints.index(name)
        if index not in coupled:
            entries.append(_geared(robot, settings, name, index))
    entries.sort(key=lambda entry: (entry.row, entry.column))
    return Actuation(len(joints), tuple(entries), remarks)


def _undriven(robot: Robot, settings: Settings, driven: Sequence[str]) -> Iterator[Diagnostic]:
    """Yield remarks on joints without a transmission where others have one: perhaps passive, perhaps forgotten."""
    transmitted: set[str] = set()
    for transmission in robot.transmissions:
        transmitted.update(transmission.joint_names)
    # most URDFs have no transmissions at all: their absence says nothing
    if transmitted.isdisjoint(driven):
        return
    for name in driven:
        if name not in transmitted and name not in settings.joints:
            message = "no transmission drives it, others have one: taken as driven (otherwise write actuated: false)"
            yield Diagnostic("info", "no-transmission", f"joint {name!r}", robot.joint[name].line, message)


def _geared(robot: Robot, settings: Settings, name: str, index: int) -> InputEntry:
    """Return the gear between a motor and its joint: the sidecar's, else the URDF's, else a gain to be trained."""
    joint = settings.joint(name)
    gear: float | None = joint.gear
    if "gear" not in joint.model_fields_set:
        gear = _reduction(robot, name)
    # a gain that nobody knows is learned from the logs rather than assumed to be 1
    if gear is None:
        return InputEntry(index, index, "gain", 1.0)
    if joint.gain == "trained":
        return InputEntry(index, index, "gain", gear)
    return InputEntry(index, index, "fixed", gear)


def _reduction(robot: Robot, name: str) -> float | None:
    """Return the reduction of a joint's simple transmission, where the URDF gives one that is not zero."""
    for transmission in robot.transmissions:
        if _SIMPLE in transmission.type and transmission.joint_names == [name]:
            collect(transmission.errors)
            reductions = [reduction for _, reduction in transmission.actuators if reduction]
            # two actuators on one joint share the load in a way that no file says
            if len(reductions) == 1:
                return reductions[0]
    return None


def _couplings(robot: Robot, settings: Settings, joints: Sequence[str]) -> list[InputEntry]:
    """Return the sidecar's couplings, then the URDF's differential transmissions of joints not coupled there."""
    entries: list[InputEntry] = []
    coupled: set[str] = set()
    errors = []
    for coupling in settings.couplings:
        locked = [name for name in coupling.joints if name not in joints]
        # a coupling of locked joints alone concerns another part of the robot
        if len(locked) < len(coupling.joints):
            for name in locked:
                errors.append(_locked(name, joints))
            coupled.update(coupling.joints)
            if not locked:
                entries += _block(joints, coupling.joints, coupling.matrix)
    collect(errors)
    for transmission in robot.transmissions:
        if _is_differential(transmission, set(joints) - coupled):
            if transmission.errors and settings.torque == "joint":
                continue  # what is not needed must not refuse the arm
            collect(transmission.errors)
            entries += _block(joints, transmission.joint_names, _differential(transmission))
            coupled.update(transmission.joint_names)
    return entries


def _locked(name: str, joints: Sequence[str]) -> SettingsError:
    expected = f"joints of the arm: {', '.join(joints)}"
    return SettingsError(f"the joint {name!r}, which is locked", element="couplings", expected=expected)


def _is_differential(transmission: Transmission, free: Collection[str]) -> bool:
    names = transmission.joint_names
    pair = len(names) == len(transmission.actuators) == 2
    return _DIFFERENTIAL in transmission.type and pair and set(names) <= set(free)


def _differential(transmission: Transmission) -> tuple[tuple[float, float], ...]:
    """Return joint torques by motor torques: both motors move both joints.

    ROS transmission_interface, DifferentialTransmission; a reduction of 0 or none counts as 1.
    """
    first, second = (reduction or 1.0 for _, reduction, _ in transmission.joints)
    a, b = (reduction or 1.0 for _, reduction in transmission.actuators)
    return ((first * a, first * b), (second * a, -second * b))


def _block(
    joints: Sequence[str], names: Sequence[str], matrix: Sequence[Sequence[float]]
) -> Iterator[InputEntry]:
    """Yield the entries of G, not zero, of the joints called ``names``."""
    for row, values in zip(names, matrix, strict=True):
        for column, value in zip(names, values, strict=True):
            if value:
                yield InputEntry(joints.index(row), joints.index(column), "coupled", value)
