"""The whole way from a URDF to a module: read, derive, plan, write; and the way back, ``check``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from spelgen.arm.arm import Arm, make_arm
from spelgen.emission.emit import emit
from spelgen.emission.plan import plan_model
from spelgen.errors import ModuleError
from spelgen.inspection import Inspection
from spelgen.settings.settings import Settings, check_joint_names, load_settings
from spelgen.spec import Assume, ModelSpec, Net, Options, Preset, read_header
from spelgen.structure.structure import derive
from spelgen.urdf.actuation import Actuation, derive_actuation
from spelgen.urdf.read import read_urdf
from spelgen.urdf.robot import Robot
from spelgen.verify import verify as verification
from spelgen.verify.agreement import Verification


@dataclass(frozen=True)
class Loaded:
    """A URDF as read, its sidecar's settings, and the arm taken from them."""

    robot: Robot
    settings: Settings
    arm: Arm
    actuation: Actuation


@dataclass(frozen=True)
class CheckResult:
    """Whether a module is what its URDF gives today; ``reasons`` say why it is not."""

    urdf: Path
    fresh: bool
    reasons: tuple[str, ...]
    proof: Verification


def load(
    path: str | Path,
    joints: Sequence[str] | None = None,
    tip: str | None = None,
    snap_tolerance: float = 2e-3,
) -> Loaded:
    """Read the URDF at ``path`` and its sidecar, and take the arm from it.

    ``joints`` names the moving joints, or ``tip`` the last link; else the longest actuated chain.
    ``snap_tolerance`` is in rad; at 0 the file's numbers are believed as they stand. Raises UrdfError,
    ArmError or SettingsError.
    """
    path = Path(path)
    robot = read_urdf(path)
    settings = load_settings(path)
    check_joint_names(settings, [joint.name for joint in robot.joints], path)
    arm = make_arm(robot, joints=joints, tip=tip, snap_tolerance=snap_tolerance, gravity=settings.gravity)
    coordinates = tuple(
        replace(coordinate, passive=not settings.joint(coordinate.name).actuated)
        for coordinate in arm.coordinates
    )
    actuation = derive_actuation(robot, settings, [coordinate.name for coordinate in coordinates])
    return Loaded(robot, settings, replace(arm, coordinates=coordinates), actuation)


def inspect(
    path: str | Path,
    joints: Sequence[str] | None = None,
    tip: str | None = None,
    assume: Assume = "kinematics",
    *,
    snap_tolerance: float = 2e-3,
) -> Inspection:
    """Derive the structure of the arm in the URDF at ``path``; arguments and errors as for ``load``."""
    loaded = load(path, joints, tip, snap_tolerance)
    structure = derive(loaded.arm, assume)
    diagnostics = (*loaded.robot.diagnostics, *loaded.arm.diagnostics, *loaded.actuation.diagnostics)
    return Inspection(loaded.arm, structure, loaded.actuation, diagnostics)


def build(
    path: str | Path,
    joints: Sequence[str] | None = None,
    tip: str | None = None,
    assume: Assume = "kinematics",
    *,
    snap_tolerance: float = 2e-3,
    preset: Preset = "minimal",
    net: Net | None = None,
    width: int = 64,
    depth: int = 2,
) -> str:
    """The source of the module tailored to the arm in the URDF at ``path``; arguments and errors as for
    ``load``.
    """
    options = Options(
        preset=preset,
        net=net,
        assume=assume,
        joints=None if joints is None else tuple(joints),
        tip=tip,
        snap_tolerance=snap_tolerance,
        width=width,
        depth=depth,
    )
    return emit(make_spec(path, options))


def make_spec(path: str | Path, options: Options) -> ModelSpec:
    """The spec of the module that ``options`` ask for."""
    loaded = load(path, options.joints, options.tip, options.snap_tolerance)
    structure = derive(loaded.arm, options.assume)
    drives = {c.name: loaded.settings.joint(c.name) for c in loaded.arm.coordinates}
    return plan_model(
        loaded.arm,
        structure,
        loaded.actuation,
        options,
        urdf=Path(path).name,
        urdf_sha256=loaded.robot.digest,
        rotors={name: drive.rotor_inertia * drive.gear**2 for name, drive in drives.items()},
    )


def check(module: str | Path, urdf: str | Path | None = None) -> CheckResult:
    """Build the module at ``module`` again, with its own options, compare, and prove its structure
    numerically.

    Without ``urdf`` the URDF is looked for by name beside the module, in the current folder and in
    ``robots/``. Raises ModuleError when there is none or when the file is no emitted module.
    """
    module = Path(module)
    header = read_header(module)
    options = header.options
    found = Path(urdf) if urdf is not None else find_urdf(module, header.urdf)
    spec = make_spec(found, options)
    reasons = []
    if spec.urdf_sha256 != header.urdf_sha256:
        reasons.append(f"{found} has changed since the module was built")
    if spec.sha256 != header.spec_sha256:
        reasons.append("the derived model differs from the one in the module")
    if emit(spec) != module.read_text(encoding="utf-8"):
        reasons.append("the module's text differs from what `spelgen build` writes now")
    proof = verify(found, options.joints, options.tip, options.assume, snap_tolerance=options.snap_tolerance)
    reasons += [str(difference) for difference in proof.differences]
    return CheckResult(found, not reasons, tuple(reasons), proof)


def verify(
    path: str | Path,
    joints: Sequence[str] | None = None,
    tip: str | None = None,
    assume: Assume = "kinematics",
    *,
    snap_tolerance: float = 2e-3,
) -> Verification:
    """Prove the structure that ``inspect`` derives once more, by numbers and by other programs.

    Arguments and errors as for ``load``; SpelgenError without Pinocchio.
    """
    loaded = load(path, joints, tip, snap_tolerance)
    return verification.verify(loaded.robot, loaded.arm, derive(loaded.arm, assume))


def find_urdf(module: Path, name: str) -> Path:
    """The URDF called ``name`` near ``module``. Raises ModuleError."""
    places = [module.parent, Path(), Path("robots"), module.parent / "robots"]
    for place in places:
        if (place / name).is_file():
            return place / name
    raise ModuleError(
        f"its URDF {name!r} is in none of " + ", ".join(dict.fromkeys(str(place) for place in places)),
        file=module,
        do="name it with --robot",
    )
