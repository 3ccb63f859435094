"""ModelSpec: everything that a model is made of, as frozen data with a canonical JSON form.

It is the boundary between deriving and training: the derivation of structure produces it, and models are
assembled and modules are written from it.
"""

import hashlib
import json
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

from spelgen.design import Design
from spelgen.errors import ModuleError, SettingsError
from spelgen.urdf.robot import Assume, JointType

Kind = Literal["zero", "constant", "varying"]
Triple = tuple[float, float, float]
Entries = tuple[tuple[int, int, float], ...]
"""A sparse symmetric matrix by its lower triangle: (row, column, value), from 0."""

# Format of specifications. It changes when a specification, or weights, of an earlier version cannot be used any more.
SPEC_FORMAT = 9


@dataclass(frozen=True)
class Options:
    """The options of `spelgen build`; with the URDF they determine the model."""

    preset: str = "hybrid"
    design: Design | None = None
    """None: the preset of this name, which comes with spelgen."""
    assume: Assume = "kinematics"
    joints: tuple[str, ...] | None = None
    tip: str | None = None
    angle_tolerance: float = 2e-3
    width: int = 64
    depth: int = 2

    def __post_init__(self) -> None:
        """Raise SettingsError for networks that are too large for memory."""
        # weights in the hidden layers of one network: 134 MB in double precision
        max_weights = 2**24
        if not (self.width >= 1 and 1 <= self.depth <= 16 and self.width**2 * self.depth <= max_weights):
            expected = f"1 to 16 layers of at least 1, with at most {max_weights:,} weights"
            raise SettingsError(f"{self.depth} hidden layers of {self.width} units", expected=expected)


@dataclass(frozen=True)
class JointSpec:
    """A joint by its name in the URDF; units are rad or m, and Nm or N."""

    name: str
    joint_type: JointType
    lower: float | None
    upper: float | None
    center: float
    half_range: float
    """The position of a prismatic joint is scaled as (q - center) / half_range."""
    speed: float
    """Typical velocity [rad/s, m/s]."""
    friction: float
    """Typical friction torque, the initial value [Nm, N]."""
    armature: float
    """Rotor inertia times gear ratio squared, the initial value [kg m^2, kg]; 0: none."""
    gear: float
    """Revolutions of the motor per revolution of the joint."""
    mass_sensitivity: float
    """Change of M with this joint, relative to the joint of the largest change."""
    potential_sensitivity: float
    """The same of V."""


@dataclass(frozen=True)
class LinkSpec:
    """A rigid body and its initial inertial parameters, in the frame of its joint, whose z is the axis."""

    name: str
    parent: int
    """Index of the link that carries it; -1: the base."""
    joint: int
    """Index of the joint that moves it by ratio * q + offset."""
    joint_type: JointType
    ratio: float
    offset: float
    position: Triple
    """Origin of the joint's frame in the parent's frame at q = 0 [m]."""
    rotation: tuple[Triple, Triple, Triple]
    mass: float
    center_of_mass: Triple
    inertia: tuple[float, float, float, float, float, float]
    """About the center of mass, (xx, xy, xz, yy, yz, zz) [kg m^2]."""


@dataclass(frozen=True)
class ServoSpec:
    """The position servo of a joint; N and m instead of Nm and rad if it is prismatic."""

    kp: float
    """Torque per distance from the command, the initial value [Nm/rad]."""
    known: bool
    """Whether kp is known, and therefore not trained."""
    kd: float
    """Torque per velocity, the initial value [Nm s/rad]."""
    limit: float | None
    """Largest torque; None: unlimited."""


@dataclass(frozen=True)
class OutputSpec:
    """A learned function f(q) = mean + scale x network of ``joints``; its contribution to M is f times ``basis``."""

    joints: tuple[int, ...]
    basis: Entries
    mean: float
    scale: float


@dataclass(frozen=True)
class ConstantSpec:
    """A trained constant in units of ``scale``; its contribution to M is the constant times ``basis``."""

    basis: Entries
    start: float
    scale: float


@dataclass(frozen=True)
class InputSpec:
    """An entry of the input matrix G: the torque of a joint per input of a motor."""

    joint: int
    motor: int
    value: float
    trained: bool


@dataclass(frozen=True)
class ModelSpec:
    """A model; indices are from 0. Raises ModuleError if indices and names contradict each other."""

    robot: str
    urdf: str
    urdf_sha256: str
    gravity: Triple
    options: Options
    design: Design
    joints: tuple[JointSpec, ...]
    entries: tuple[tuple[int, int, Kind, tuple[int, ...]], ...]
    """(row, column, kind, joints) of the lower triangle of M, for people."""
    outputs: tuple[OutputSpec, ...]
    constants: tuple[ConstantSpec, ...]
    potential: tuple[int, ...]
    """The joints that V depends on."""
    potential_scale: float
    margin: float
    """Smallest eigenvalue of M relative to the nominal mean of M, below which M is corrected."""
    started_from_urdf: bool
    """Whether the initial inertial parameters are from the URDF."""
    links: tuple[LinkSpec, ...] = ()
    """Of a model of rigid bodies."""
    inputs: tuple[InputSpec, ...] = ()
    """Empty: each input is the torque of its own joint."""
    motor_speeds: tuple[tuple[float, ...], ...] = ()
    """Rows of C: the motors rotate at C qd; empty: each motor drives its own joint."""
    servos: tuple[ServoSpec, ...] = ()
    """Of joints whose inputs are commanded positions."""

    def __post_init__(self) -> None:
        # A specification from a file is untrusted: an index beyond its table would fail in the middle of the
        # assembly.
        n, links = len(self.joints), self.links
        joints = [*self.potential, *(x.joint for x in links), *(j for x in self.outputs for j in x.joints)]
        bases = [x.basis for x in self.outputs] + [x.basis for x in self.constants]
        joints += [index for basis in bases for row in basis for index in row[:2]]
        joints += [index for x in self.inputs for index in (x.joint, x.motor)]
        joints += [index for row, column, _, depends in self.entries for index in (row, column, *depends)]
        # logs and exports find joints and links by name
        names = [joint.name for joint in self.joints], [link.name for link in links]
        consistent = (
            n > 0
            and all(0 <= joint < n for joint in joints)
            and all(-1 <= link.parent < index for index, link in enumerate(links))
            and all(len(set(group)) == len(group) for group in names)
            and [len(row) for row in self.motor_speeds] in ([], [n] * n)
            and len(self.servos) in (0, n)
        )
        if not consistent:
            raise ModuleError("a specification whose indices contradict each other", do="build it again")

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints in the URDF, which logs use."""
        return tuple(joint.name for joint in self.joints)

    @property
    def joint_types(self) -> tuple[JointType, ...]:
        """``revolute`` or ``prismatic``, for each joint."""
        return tuple(joint.joint_type for joint in self.joints)

    def to_json(self) -> str:
        """Return the canonical JSON, in one line of ASCII."""
        # Sorted keys and no blanks: equal specifications have equal digests.
        plain = {"format": SPEC_FORMAT, **asdict(self)}
        return json.dumps(plain, sort_keys=True, ensure_ascii=True, separators=(",", ":"))

    @cached_property
    def sha256(self) -> str:
        """Digest of the canonical JSON."""
        return hashlib.sha256(self.to_json().encode()).hexdigest()


def spec_from_json(text: str, file: Path | None = None) -> ModelSpec:
    """Return the specification in a JSON text. Raises ModuleError, which names ``file``."""
    from pydantic import TypeAdapter, ValidationError  # slow to import

    try:
        content = json.loads(text, parse_constant=_no_number)
        # The format is compared before the keys, so that the error of an older file is clear.
        version = content.pop("format") if isinstance(content, dict) and "format" in content else None
        if version != SPEC_FORMAT:
            expected = f"{SPEC_FORMAT}, of this version"
            again = "build the module again with `spelgen build`, and train it again"
            raise ModuleError(
                f"a specification of format {version!r}", file=file, expected=expected, do=again
            )
        spec = TypeAdapter(ModelSpec).validate_python(content)
        # Compared with its own JSON form: pydantic converts values and ignores unknown keys.
        if json.loads(spec.to_json()) == {"format": version, **content}:
            return spec
        # not ignored: a specification that was edited by hand would be another model than its text states
        reason = "keys or values of other types"
    except (ValidationError, ValueError, RecursionError, SettingsError) as problem:
        reason = " ".join(str(problem).split())[:200]
    raise ModuleError(
        f"no specification of a model ({reason})", file=file, expected="JSON as `spelgen build` writes it",
        do="build the module again with `spelgen build`",
    )  # fmt: skip


def _no_number(name: str) -> float:
    raise ValueError(f"{name} is no number of a specification")
