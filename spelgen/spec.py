"""ModelSpec: everything an emitted module is made from, as plain frozen data. The wall between deriving and
training.

Also reads back the record that an emitted module carries in its docstring.
"""

from __future__ import annotations

import ast
import hashlib
import json
import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import yaml

from spelgen.errors import ModuleError

Assume = Literal["kinematics", "inertials"]
Kind = Literal["zero", "constant", "varying"]
Preset = Literal["minimal", "spel", "spel-kan", "phnode", "closed-form"]
Net = Literal["mlp", "kan"]
Entries = tuple[tuple[int, int, float], ...]
"""A sparse symmetric matrix by its lower triangle: (row, column, value), 0-based."""

Terms = tuple[tuple[int, float, float], ...]
"""A sum of waves: (place in ModelSpec.waves, factor of the cosine, factor of the sine), to start from."""

_PRESETS = Path(__file__).parent / "presets"


@dataclass(frozen=True)
class Design:
    """A point in the space of models: how each quantity of the equations of motion is made.

    derived: by the arm's structure. dense: as if nothing were known of the arm (Wang et al., Sci Rep
    15:33179, 2025, and Duong et al., IEEE T-RO 40:3695, 2024), over all three axes of each joint where it
    says 3n. closed-form: that of rigid bodies with trained inertial parameters. constants: friction's laws with
    trained constants.
    """

    mass: Literal["derived", "dense-3n", "closed-form"]
    potential: Literal["derived", "dense", "closed-form"]
    dissipation: Literal["per-joint", "dense-n", "dense-3n", "constants"]
    input: Literal["derived", "dense-3n"]
    waves: Literal["derived", "none"]
    """Whether networks add to the sums of waves that a rigid arm's functions are, where those are short."""
    net: Net
    encoding: Literal["own", "group"]
    """What a network reads: cos q and sin q or scaled q of the joints it depends on, or the nine or three
    numbers of every joint's R or r.
    """


def load_design(preset: Preset, net: Net | None = None) -> Design:
    """The design that ``presets/PRESET.yaml`` names, with ``net`` in place of its own network if given."""
    data = yaml.safe_load((_PRESETS / f"{preset}.yaml").read_text(encoding="utf-8"))
    del data["about"]
    return Design(**(data | ({"net": net} if net else {})))


@dataclass(frozen=True)
class Options:
    """What the user chose when building; enough to build the same module again from the same URDF."""

    preset: Preset = "minimal"
    net: Net | None = None
    """None: the preset's own."""
    assume: Assume = "kinematics"
    joints: tuple[str, ...] | None = None
    tip: str | None = None
    snap_tolerance: float = 2e-3
    width: int = 64
    depth: int = 2


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
    rotor: float
    """What the drive adds to M, to start from [kg m^2, kg]; 0: nothing."""
    mass_share: float
    potential_share: float
    """How much M, or V, changes with this joint, relative to the joint it changes with most."""
    actuated: bool


Triple = tuple[float, float, float]


@dataclass(frozen=True)
class BodySpec:
    """A body of a closed-form model, as ``arm.Body`` has it, with the inertial parameters to start from."""

    parent: int
    joint: int
    kind: Literal["revolute", "prismatic"]
    ratio: float
    offset: float
    rotation: tuple[Triple, Triple, Triple]
    position: Triple
    reference: tuple[float, ...]


@dataclass(frozen=True)
class OutputSpec:
    """One learned function of ``joints``: f(q) = center + scale x network, entering M through ``basis``."""

    joints: tuple[int, ...]
    basis: Entries
    center: float
    scale: float
    level: float | None = None
    terms: Terms = ()
    """With a level: f(q) = level + its terms' waves + a part of the network."""


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
    guard: float
    """M is lifted where its least eigenvalue, relative to the nominal mean M, falls below this."""
    started_from_urdf: bool
    waves: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...] = ()
    """(turns, powers), by joint, of x^powers cos(turns q) and x^powers sin(turns q)."""
    potential_terms: Terms | None = None
    """What V is the sum of, beside a part of the network; None: of the network alone."""
    bodies: tuple[BodySpec, ...] = ()
    """Of a closed-form model."""
    inputs: tuple[tuple[int, int, float, bool], ...] = ()
    """(row, column, value, trained) of G; none where each torque acts on its own actuated joint as it is."""

    def to_json(self) -> str:
        """Canonical JSON; ``from_json`` gives the same spec back."""
        return json.dumps(asdict(self), sort_keys=True, ensure_ascii=True)

    @classmethod
    def from_json(cls, text: str) -> ModelSpec:
        """The spec that ``to_json`` wrote."""
        data = _tupled(json.loads(text))
        data["options"] = Options(**data["options"])
        data["design"] = Design(**data["design"])
        data["joints"] = tuple(JointSpec(**joint) for joint in data["joints"])
        data["outputs"] = tuple(OutputSpec(**output) for output in data["outputs"])
        data["bodies"] = tuple(BodySpec(**body) for body in data["bodies"])
        data["constants"] = tuple(ConstantSpec(**constant) for constant in data["constants"])
        return cls(**data)

    @property
    def sha256(self) -> str:
        """Digest of the canonical JSON."""
        return hashlib.sha256(self.to_json().encode()).hexdigest()


def _tupled(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _tupled(item) for key, item in value.items()}
    return tuple(_tupled(item) for item in value) if isinstance(value, list) else value


@dataclass(frozen=True)
class Header:
    """What an emitted module says of itself. ``joints`` are the URDF's own names, which logs use."""

    robot: str
    urdf: str
    urdf_sha256: str
    spec_sha256: str
    options: Options
    joints: tuple[str, ...]
    joint_types: tuple[str, ...]


_JOINT_LINE = re.compile(r'^ {4}\d+ +("(?:[^"\\]|\\.)*") +(revolute|prismatic)\b', re.MULTILINE)
_RECORD_LINE = re.compile(r"^ {4}(\w+): (.+)$", re.MULTILINE)
_OPTION_LINE = re.compile(r"^ {4}option (\w+): (.+)$", re.MULTILINE)


def read_header(path: str | Path) -> Header:
    """The record in the docstring of the emitted module at ``path``. Raises ModuleError when there is none."""
    path = Path(path)
    try:
        text = ast.get_docstring(ast.parse(path.read_bytes()), clean=False) or ""
        record = {key: json.loads(value) for key, value in _RECORD_LINE.findall(text)}
        options = {key: _tupled(json.loads(value)) for key, value in _OPTION_LINE.findall(text)}
        rows = [(json.loads(name), kind) for name, kind in _JOINT_LINE.findall(text)]
        return Header(
            robot=record["robot"],
            urdf=record["urdf"],
            urdf_sha256=record["urdf_sha256"],
            spec_sha256=record["spec_sha256"],
            options=Options(**options),
            joints=tuple(name for name, _ in rows),
            joint_types=tuple(kind for _, kind in rows),
        )
    except FileNotFoundError:
        raise ModuleError("no such file", file=path, do="build it with `spelgen build`") from None
    except (OSError, SyntaxError, ValueError, KeyError, TypeError) as problem:
        raise ModuleError(
            f"no spelgen record in the docstring ({type(problem).__name__})",
            file=path,
            expected="a module written by `spelgen build`",
            do="build it again, or check the path",
        ) from None
