"""What the logs' torques do to the joints: the input matrix G of M qdd + ... = G tau, as the files say.

A log holds joint torques unless the sidecar says ``torque: motor``; then gears and coupled wrists stand between.
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
    """An entry of G that is not zero, 0-based: known (``fixed``, or ``coupled`` where one motor moves several
    joints), or a ``gain`` that is trained and starts at ``value``.
    """

    row: int
    column: int
    kind: InputKind
    value: float


class Drives(NamedTuple):
    """Matrices (n, n) of the motors of n joints.

    inputs: G, the joints' torques are G times what is logged. speeds: C, the motors' speeds are C qd, in units of the
    joints: friction and rotors belong to them (see `motor_speeds`).
    """

    inputs: np.ndarray
    speeds: np.ndarray


@dataclass(frozen=True)
class Actuation:
    """G of n joints by its entries, and what there is to tell about it.

    couplings: joint torques by motor torques where what is logged is at the joints already, but motors move several.
    """

    joints: int
    entries: tuple[InputEntry, ...]
    diagnostics: tuple[Diagnostic, ...] = ()
    couplings: tuple[InputEntry, ...] = ()

    @property
    def direct(self) -> bool:
        """Whether every torque acts on its own joint as it is."""
        return all((x.row, x.kind, x.value) == (x.column, "fixed", 1.0) for x in self.entries)

    def matrix(self) -> np.ndarray:
        """G (n, n), gains at their start."""
        return self._matrix(self.entries)

    def drives(self) -> Drives:
        """G, and how the motors turn."""
        coupled = {entry.row for entry in self.couplings}
        own = tuple(entry for entry in self.entries if entry.row not in coupled)
        return Drives(self.matrix(), motor_speeds(self._matrix((*own, *self.couplings))))

    def _matrix(self, entries: Sequence[InputEntry]) -> np.ndarray:
        full = np.zeros((self.joints, self.joints))
        for entry in entries:
            full[entry.row, entry.column] = entry.value
        return full


def motor_speeds(inputs: np.ndarray) -> np.ndarray:
    """C, (n, n): the motors' speeds are C qd, where the joints' torques are ``inputs`` times the motors'.

    By the same power, each motor's in the units of the joint that it moves most: C is the identity where each moves
    its own joint alone. A joint without a motor stands for its own.
    """
    largest = np.take_along_axis(inputs, np.abs(inputs).argmax(axis=0)[None], axis=0)
    passive = largest == 0
    speeds: np.ndarray = (inputs / np.where(passive, 1.0, largest)).T + np.diag(passive[0].astype(float))
    return speeds


def derive_actuation(robot: Robot, settings: Settings, joints: Sequence[str]) -> Actuation:
    """G of the arm with these ``joints``.

    Raises SettingsError for couplings with locked joints, UrdfError for a transmission that is needed and
    has unusable numbers.
    """
    driven = [name for name in joints if settings.joint(name).actuated]
    notes = tuple(_undriven(robot, settings, driven))
    coupled = [entry for coupling in _couplings(robot, settings, joints) for entry in coupling]
    if settings.torque == "joint":
        entries = [InputEntry(joints.index(x), joints.index(x), "fixed", 1.0) for x in driven]
        return Actuation(len(joints), tuple(entries), notes, tuple(coupled))
    entries, taken = coupled, {entry.row for entry in coupled}
    for name in driven:
        index = joints.index(name)
        if index not in taken:
            entries.append(_geared(robot, settings, name, index))
    return Actuation(len(joints), tuple(sorted(entries, key=lambda x: (x.row, x.column))), notes)


def _undriven(robot: Robot, settings: Settings, driven: Sequence[str]) -> Iterator[Diagnostic]:
    """Joints without a transmission where others have one: perhaps passive, perhaps forgotten."""
    named = {name for each in robot.transmissions for name, _, _ in each.joints}
    if not named & set(driven):
        return
    for name in driven:
        if name not in named and name not in settings.joints:
            message = "no transmission drives it, others have one: taken as driven (else say actuated: false)"
            yield Diagnostic("info", "no-transmission", f"joint {name!r}", robot.joint[name].line, message)


def _geared(robot: Robot, settings: Settings, name: str, index: int) -> InputEntry:
    """The gear between a motor and its joint: the sidecar's, else the URDF's, else a gain to be trained."""
    joint = settings.joint(name)
    gear = joint.gear if "gear" in joint.model_fields_set else _reduction(robot, name)
    kind: InputKind = "gain" if gear is None or joint.gain == "trained" else "fixed"
    return InputEntry(index, index, kind, 1.0 if gear is None else gear)


def _reduction(robot: Robot, name: str) -> float | None:
    """The reduction of a joint's simple transmission, where the URDF gives one that is not zero."""
    for each in robot.transmissions:
        if _SIMPLE in each.type and [joint for joint, _, _ in each.joints] == [name]:
            collect(each.errors)
            found = [reduction for _, reduction in each.actuators if reduction]
            if len(found) == 1:
                return found[0]
    return None


def _couplings(robot: Robot, settings: Settings, joints: Sequence[str]) -> list[list[InputEntry]]:
    """The sidecar's couplings, then the URDF's differential transmissions of joints not coupled there."""
    taken = [x for x in settings.couplings if set(x.joints) & set(joints)]
    collect([_absent(name, joints) for x in taken for name in x.joints if name not in joints])
    coupled = {name for coupling in taken for name in coupling.joints}
    found = [_block([joints.index(name) for name in x.joints], x.matrix) for x in taken]
    for each in robot.transmissions:
        names = [name for name, _, _ in each.joints]
        two = len(names) == len(each.actuators) == 2
        if _DIFFERENTIAL in each.type and two and set(names) <= set(joints) - coupled:
            if each.errors and settings.torque == "joint":
                continue  # what is not needed must not refuse the arm
            collect(each.errors)
            found.append(_block([joints.index(name) for name in names], _differential(each)))
            coupled |= set(names)
    return found


def _absent(name: str, joints: Sequence[str]) -> SettingsError:
    expected = f"joints of the arm: {', '.join(joints)}"
    return SettingsError(f"the joint {name!r}, which is locked", element="couplings", expected=expected)


def _differential(each: Transmission) -> tuple[tuple[float, float], ...]:
    """Joint torques by motor torques (ROS transmission_interface, DifferentialTransmission): both motors move both."""
    (_, first, _), (_, second, _) = each.joints
    (_, left), (_, right) = each.actuators
    one, other = first or 1.0, second or 1.0
    a, b = left or 1.0, right or 1.0
    return ((one * a, one * b), (other * a, -other * b))


def _block(rows: Sequence[int], matrix: Sequence[Sequence[float]]) -> list[InputEntry]:
    return [
        InputEntry(row, column, "coupled", value)
        for row, values in zip(rows, matrix, strict=True)
        for column, value in zip(rows, values, strict=True)
        if value
    ]
