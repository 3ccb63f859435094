"""ModelSpec: the complete specification of a model, as frozen data with a canonical JSON form.

The derivation of an arm's structure produces a ModelSpec; models are assembled and modules are written from it.
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
"""Lower triangle of a sparse symmetric matrix: (row, column, value) of each entry, with indices from 0."""

# Version of the JSON format of a ModelSpec. It changes when specifications or weights of an earlier version of spelgen
# become unusable.
SPEC_FORMAT = 9


@dataclass(frozen=True)
class Options:
    """The options of `spelgen build`; URDF and options determine the model."""

    preset: str = "hybrid"
    design: Design | None = None
    """Design from a YAML file; None: the design is the preset of spelgen with the name ``preset``."""
    assume: Assume = "kinematics"
    joints: tuple[str, ...] | None = None
    tip: str | None = None
    angle_tolerance: float = 2e-3
    width: int = 64
    depth: int = 2

    def __post_init__(self) -> None:
        """Raise SettingsError for networks that are too large for memory."""
        # Largest number of weights in the hidden layers of one network: 134 MB in double precision.
        max_weights = 2**24
        if not (self.width >= 1 and 1 <= self.depth <= 16 and self.width**2 * self.depth <= max_weights):
            expected = f"1 to 16 layers of at least 1, with at most {max_weights:,} weights"
            raise SettingsError(f"{self.depth} hidden layers of {self.width} units", expected=expected)


@dataclass(frozen=True)
class JointSpec:
    """A joint of the model. Units of a revolute joint are rad and Nm, of a prismatic joint m and N."""

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
    """Change of M with the position of this joint, divided by the largest such change of all joints."""
    potential_sensitivity: float
    """Change of V with the position of this joint, divided by the largest such change of all joints."""

    @property
    def limits(self) -> tuple[float, float] | None:
        """Lower and upper position limit [rad, m]; None for a joint without limits, or with only one of them."""
        return None if self.lower is None or self.upper is None else (self.lower, self.upper)


@dataclass(frozen=True)
class LinkSpec:
    """A rigid body and its initial inertial parameters, in the frame of its joint; the z axis is the joint axis."""

    name: str
    parent: int
    """Index of the link that carries this link; -1: the base."""
    joint: int
    """Index of the joint whose position q moves this link by ratio * q + offset."""
    joint_type: JointType
    ratio: float
    offset: float
    position: Triple
    """Origin of the joint's frame in the parent's frame at displacement 0 [m]."""
    rotation: tuple[Triple, Triple, Triple]
    mass: float
    center_of_mass: Triple
    inertia: tuple[float, float, float, float, float, float]
    """Inertia tensor about the center of mass, (xx, xy, xz, yy, yz, zz) [kg m^2]."""


@dataclass(frozen=True)
class ServoSpec:
    """The position servo of a joint. For a prismatic joint the units are N and m instead of Nm and rad."""

    kp: float
    """Initial value of the proportional gain: torque per position error [Nm/rad]."""
    known: bool
    """Whether kp is known, and therefore not trained."""
    kd: float
    """Initial value of the damping gain: torque per velocity [Nm s/rad]."""
    limit: float | None
    """Largest torque [Nm]; None: unlimited."""


@dataclass(frozen=True)
class OutputSpec:
    """A learned function f(q) = mean + scale * network(q of ``joints``). M contains f times the matrix ``basis``."""

    joints: tuple[int, ...]
    basis: Entries
    mean: float
    scale: float


@dataclass(frozen=True)
class ConstantSpec:
    """A trained constant c with the initial value ``start``. M contains c times the matrix ``basis``.

    The parameter that is trained is c divided by ``scale``.
    """

    basis: Entries
    start: float
    scale: float


@dataclass(frozen=True)
class InputSpec:
    """An entry of the input matrix G: the torque of joint ``joint`` per unit of the input of motor ``motor``."""

    joint: int
    motor: int
    value: float
    trained: bool


@dataclass(frozen=True)
class ModelSpec:
    """Specification of a model, from which its PyTorch module is written; indices are from 0.

    Raises ModuleError if an index is out of range, a name occurs twice, or a tuple has a wrong length.
    """

    robot: str
    urdf: str
    urdf_sha256: str
    gravity: Triple
    options: Options
    design: Design
    joints: tuple[JointSpec, ...]
    entries: tuple[tuple[int, int, Kind, tuple[int, ...]], ...]
    """Description of the lower triangle of M: (row, column, zero/constant/varying, joints it depends on)."""
    outputs: tuple[OutputSpec, ...]
    constants: tuple[ConstantSpec, ...]
    potential: tuple[int, ...]
    """The joints that V depends on."""
    potential_scale: float
    margin: float
    """Lower bound of the generalised eigenvalues of M relative to its nominal mean; below it, M is corrected."""
    started_from_urdf: bool
    """Whether the initial inertial parameters are from the URDF."""
    links: tuple[LinkSpec, ...] = ()
    """Bodies of a rigid-body model; empty for other models."""
    inputs: tuple[InputSpec, ...] = ()
    """Entries of G; empty if each input is the torque of one joint (G is the identity)."""
    motor_speeds: tuple[tuple[float, ...], ...] = ()
    """Rows of C, which gives the motor velocities C qd; empty if each motor drives one joint (C is the identity)."""
    servos: tuple[ServoSpec, ...] = ()
    """Position servos of the joints; empty for an arm whose inputs are torques."""

    def __post_init__(self) -> None:
        # A specification from a file is untrusted: without this check an index out of range would fail later,
        # during the assembly of a model, with an unclear error.
        n, links = len(self.joints), self.links
        joints = [*self.potential, *(link.joint for link in links)]
        for output in self.outputs:
            joints += output.joints
        for basis in [x.basis for x in self.outputs] + [x.basis for x in self.constants]:
            for row, column, _ in basis:
                joints += [row, column]
        for entry in self.inputs:
            joints += [entry.joint, entry.motor]
        for row, column, _, depends in self.entries:
            joints += [row, column, *depends]
        # Names must be unique, because logs and exports find joints and links by name.
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
        """Type of each joint, ``revolute`` or ``prismatic``."""
        return tuple(joint.joint_type for joint in self.joints)

    def to_json(self) -> str:
        """Return the canonical JSON of the specification, in one line of ASCII."""
        # Keys are sorted and blanks omitted, so that equal specifications have equal digests.
        plain = {"format": SPEC_FORMAT, **asdict(self)}
        return json.dumps(plain, sort_keys=True, ensure_ascii=True, separators=(",", ":"))

    @cached_property
    def sha256(self) -> str:
        """SHA-256 digest of the canonical JSON in hexadecimal, which identifies the specification."""
        return hashlib.sha256(self.to_json().encode()).hexdigest()


def spec_from_json(text: str, file: Path | None = None) -> ModelSpec:
    """Return the ModelSpec in a JSON text (see `ModelSpec.to_json`). Raises ModuleError, which names ``file``."""
    from pydantic import TypeAdapter, ValidationError  # pydantic is imported here: its import is slow

    try:
        content = json.loads(text, parse_constant=_no_number)
        # The format version is compared before the keys: the error of an older file then names its version.
        version = content.pop("format") if isinstance(content, dict) and "format" in content else None
        if version != SPEC_FORMAT:
            expected = f"{SPEC_FORMAT}, of this version"
            again = "build the module again with `spelgen build`, and train it again"
            raise ModuleError(
                f"a specification of format {version!r}", file=file, expected=expected, do=again
            )
        spec = TypeAdapter(ModelSpec).validate_python(content)
        # The specification is converted back to JSON and compared with the text, because pydantic converts values and
        # ignores unknown keys.
        if json.loads(spec.to_json()) == {"format": version, **content}:
            return spec
        # A difference between file and specification is an error: the model would not be the one that the file
        # describes.
        reason = "keys or values of other types"
    except (ValidationError, ValueError, RecursionError, SettingsError) as problem:
        reason = " ".join(str(problem).split())[:200]
    raise ModuleError(
        f"no specification of a model ({reason})", file=file, expected="JSON as `spelgen build` writes it",
        do="build the module again with `spelgen build`",
    )  # fmt: skip


def _no_number(name: str) -> float:
    raise ValueError(f"{name} is no number of a specification")
