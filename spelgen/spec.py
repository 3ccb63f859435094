"""Define ModelSpec, everything an emitted module is made from, as plain frozen data.

It is the wall between deriving and training. The facts that an emitted module carries are written and read back here.
"""

from __future__ import annotations

import ast
import hashlib
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

from spelgen.design import Design
from spelgen.errors import ModuleError, SettingsError
from spelgen.files import read_bytes
from spelgen.urdf.robot import Assume

Kind = Literal["zero", "constant", "varying"]
Entries = tuple[tuple[int, int, float], ...]
"""A sparse symmetric matrix by its lower triangle: (row, column, value), 0-based."""

MODULE_FORMAT = 8
"""Of emitted modules: it changes when a module, or weights of one, written before cannot be used any more."""
LARGEST_MODULE = 2**22  # bytes: the largest that `build` writes has a tenth
_MOST_WEIGHTS = 2**24  # of the hidden layers of one network: 134 MB in double precision
_MOST_LAYERS = 16
_FACTS_WIDTH = 100
_FOREIGN = (
    SyntaxError, ValueError, KeyError, TypeError, StopIteration, AttributeError, RecursionError, MemoryError,
)  # fmt: skip
"""What parsing a text that is no module of ours may raise."""


@dataclass(frozen=True)
class Options:
    """What the user chose when building; enough to build the same module again from the same URDF."""

    preset: str = "hybrid"
    design: Design | None = None
    """None: that of the preset of this name, which comes with spelgen."""
    assume: Assume = "kinematics"
    joints: tuple[str, ...] | None = None
    tip: str | None = None
    angle_tolerance: float = 2e-3
    width: int = 64
    depth: int = 2

    def __post_init__(self) -> None:
        """Raise SettingsError for networks that no memory holds: the facts of a module may say any number."""
        weights = self.width * self.width * self.depth
        if min(self.width, self.depth) < 1 or self.depth > _MOST_LAYERS or weights > _MOST_WEIGHTS:
            raise SettingsError(
                f"{self.depth} hidden layers of {self.width} units",
                expected=f"1 to {_MOST_LAYERS} layers of at least 1, with at most {_MOST_WEIGHTS:,} weights",
            )


@dataclass(frozen=True)
class JointSpec:
    """One joint: ``name`` as in the URDF, ``identifier`` for code; units are rad or m, and Nm or N."""

    name: str
    identifier: str
    kind: Literal["revolute", "prismatic"]
    lower: float | None
    upper: float | None
    center: float
    reach: float
    """Position is scaled as (q - center) / reach where the joint is prismatic."""
    speed: float
    friction: float
    """Size of friction torque the model starts from."""
    armature: float
    """What the drive adds to M, to start from [kg m^2, kg]; 0: nothing."""
    gear: float
    """Turns of the motor in a turn of the joint."""
    mass_sensitivity: float
    potential_sensitivity: float
    """How much M, or V, changes with this joint, relative to the joint it changes with most."""


Triple = tuple[float, float, float]


@dataclass(frozen=True)
class BodySpec:
    """A body of a closed-form model, as ``arm.Body`` has it, with the inertial parameters to start from."""

    parent: int
    joint: int
    kind: Literal["revolute", "prismatic"]
    ratio: float
    offset: float
    placement: tuple[tuple[float, ...], ...]
    """Of its joint's frame in its parent's: three rows of [R p] [m]."""
    pseudo_inertia: tuple[float, ...]
    """The upper triangle of [[S, m c], [(m c)^T, m]], row by row, with S the second moments of mass."""


@dataclass(frozen=True)
class ServoSpec:
    """The position servo of a joint; N and m in place of Nm and rad where it is prismatic."""

    kp: float
    """Torque by the distance from the command [Nm/rad], to start from."""
    known: bool
    """Whether kp is known, and so no weight."""
    kd: float
    """Torque by velocity [Nm s/rad], to start from."""
    limit: float | None
    """The most torque that it gives; None: nothing says."""


@dataclass(frozen=True)
class OutputSpec:
    """One learned function of ``joints``: f(q) = mean + scale x network, entering M through ``basis``."""

    joints: tuple[int, ...]
    basis: Entries
    mean: float
    scale: float


@dataclass(frozen=True)
class ConstantSpec:
    """One trained constant, in units of ``scale``, entering M through ``basis``."""

    basis: Entries
    start: float
    scale: float


@dataclass(frozen=True)
class ModelSpec:
    """A model, ready to be written as source text. Indices are 0-based."""

    robot: str
    urdf: str
    urdf_sha256: str
    gravity: tuple[float, float, float]
    options: Options
    design: Design
    joints: tuple[JointSpec, ...]
    entries: tuple[tuple[int, int, Kind, tuple[int, ...]], ...]
    """(row, column, kind, joints) of M's lower triangle: what a reader is shown."""
    outputs: tuple[OutputSpec, ...]
    constants: tuple[ConstantSpec, ...]
    potential: tuple[int, ...]
    potential_scale: float
    margin: float
    """The least eigenvalue of M, relative to the nominal mean M, that is left as it is."""
    started_from_urdf: bool
    bodies: tuple[BodySpec, ...] = ()
    """Of a closed-form model."""
    inputs: tuple[tuple[int, int, float, bool], ...] = ()
    """(row, column, value, trained) of G; none where every joint's own torque acts on it as it is."""
    motor_speeds: tuple[tuple[float, ...], ...] = ()
    """By joint velocities, where motors move several joints."""
    servos: tuple[ServoSpec, ...] = ()
    """Of joints that are commanded positions."""

    def to_json(self) -> str:
        """Canonical JSON."""
        plain = asdict(self)
        for name in ("servos", "motor_speeds"):  # arms without keep the digest of before there were such
            if not plain[name]:
                del plain[name]
        return json.dumps(plain, sort_keys=True, ensure_ascii=True)

    @property
    def sha256(self) -> str:
        """Digest of the canonical JSON."""
        return hashlib.sha256(self.to_json().encode()).hexdigest()


@dataclass(frozen=True)
class Facts:
    """What an emitted module says of itself. ``joints`` are the URDF's own names, which logs use."""

    robot: str
    urdf: str
    urdf_sha256: str
    spec_sha256: str
    options: Options
    joints: tuple[str, ...]
    joint_types: tuple[str, ...]


def facts_json(spec: ModelSpec) -> str:
    """What the module made from ``spec`` says of itself, as JSON for people and programs."""
    facts: dict[str, object] = {
        "format": MODULE_FORMAT,
        "robot": spec.robot,
        "urdf": spec.urdf,
        "urdf_sha256": spec.urdf_sha256,
        "spec_sha256": spec.sha256,
        "options": dict(sorted(asdict(spec.options).items())),
        "joints": {joint.name: joint.kind for joint in spec.joints},
    }
    items = [f"{json.dumps(key)}: {_filled(value)}" for key, value in facts.items()]
    return "{" + ", ".join(items[:3]) + ",\n " + ",\n ".join(items[3:]) + "}"


def _filled(value: object) -> str:
    """JSON of a value, or of a group on as many lines as it takes, with items kept whole."""
    if not isinstance(value, dict):
        return json.dumps(value)
    lines = [""]
    for key, item in value.items():
        text = f"{json.dumps(key)}: {json.dumps(item)}"
        if lines[-1] and len(lines[-1]) + len(text) > _FACTS_WIDTH:
            lines.append("")
        lines[-1] += f", {text}" if lines[-1] else text
    return "{" + ",\n  ".join(lines) + "}"


def read_facts(path: str | Path) -> Facts:
    """The facts in the emitted module at ``path``; nothing of it is executed. Raises ModuleError without them."""
    return parse_facts(read_source(path), Path(path))


def read_source(path: str | Path) -> str:
    """The text of the module at ``path``. Raises ModuleError."""
    path = Path(path)
    if not path.exists():
        raise ModuleError("no such file", file=path, do="build it with `spelgen build`")
    content = read_bytes(path, ModuleError, "a module written by `spelgen build`", LARGEST_MODULE)
    try:
        return content.decode("utf-8").replace("\r\n", "\n")
    except ValueError as problem:
        raise _no_facts(problem, path) from None


def parse_facts(source: str, file: Path | None = None) -> Facts:
    """The facts in a module's source text; nothing of it is executed. Raises ModuleError without them."""
    try:
        record = _record(source)
        if record.get("format") == MODULE_FORMAT:
            return _facts(source)
    except SettingsError as problem:
        raise ModuleError(f"options of no module ({problem})", file=file, do="build it again") from None
    except _FOREIGN as problem:
        raise _no_facts(problem, file) from None
    raise ModuleError(
        "a module of another version of spelgen",
        file=file,
        expected="a module written by this version of `spelgen build`",
        do=f"build it again from {record.get('urdf')} with `spelgen build`, and train it again",
    )


@lru_cache(maxsize=8)  # a run reads one module again and again
def _record(source: str) -> dict[str, Any]:
    record: dict[str, Any] = json.loads(next(_texts(ast.parse(source), "FACTS")))
    return record


def _facts(source: str) -> Facts:
    from pydantic import TypeAdapter  # slow to import

    record = _record(source)
    joints = record["joints"]
    # a field of another type is refused here, and not wherever it is used first
    return TypeAdapter(Facts).validate_python(
        record | {"joints": tuple(joints), "joint_types": tuple(joints.values())}
    )


def _no_facts(problem: Exception, file: Path | None) -> ModuleError:
    return ModuleError(
        f"no facts of spelgen in it ({type(problem).__name__})",
        file=file,
        expected="a module written by this version of `spelgen build`",
        do="build it again, or check the path",
    )


def _texts(tree: ast.Module, name: str) -> Iterator[str]:
    """The strings that a file assigns to ``name``."""
    for node in tree.body:
        if (
            isinstance(node, ast.Assign)
            and isinstance(node.value, ast.Constant)
            and [target.id for target in node.targets if isinstance(target, ast.Name)] == [name]
        ):
            yield str(node.value.value)


def logged_joints(model: Any) -> tuple[str, ...]:
    """The joints of a model by the names that logs use: the URDF's, or its own where it comes from none."""
    facts = getattr(model, "facts", None)
    return tuple(model.joint_names) if facts is None else facts.joints
