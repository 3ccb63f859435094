"""From a URDF to a module: load, derive, plan, write; and the way back, ``check``."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from spelgen.certificate.inspection import Inspection
from spelgen.certificate.verification import Verification
from spelgen.design import PRESET_NAMES, Design, load_design
from spelgen.emission.emit import emit
from spelgen.emission.plan import plan_model
from spelgen.errors import ModuleError, RunError, SpelgenError
from spelgen.pipeline.loaded_arm import LoadedArm, arm_of_module, load_arm
from spelgen.spec import Facts, ModelSpec, Options, parse_facts, read_facts, read_source
from spelgen.urdf.robot import Assume


def inspect(
    path: str | Path,
    joints: Sequence[str] | None = None,
    tip: str | None = None,
    assume: Assume = "kinematics",
    *,
    angle_tolerance: float = 2e-3,
) -> Inspection:
    """Derive the structure of the arm in the URDF at ``path``; arguments and errors as for ``load_arm``."""
    return load_arm(path, joints, tip, angle_tolerance).inspect(assume)


def generate(
    arm: LoadedArm | str | Path,
    preset: str | Path | Design = "hybrid",
    *,
    width: int = 64,
    depth: int = 2,
    assume: Assume = "kinematics",
    module: Path | None = None,
) -> str:
    """The source of the module tailored to an arm, or to that of a URDF.

    ``preset``: one that comes with spelgen by its name, one of yours by its YAML file, or a ``Design``.
    Its networks have ``depth`` hidden layers of ``width`` units.
    ``assume`` as for ``inspect``. ``module``: the file that the source is for, which then names the way to its URDF.
    Raises what ``load_arm`` raises, SettingsError for a design that stands for
    no model.
    """
    loaded = arm if isinstance(arm, LoadedArm) else load_arm(arm)
    name, design = str(preset), None
    if preset not in PRESET_NAMES:
        name = "own" if isinstance(preset, Design) else Path(preset).stem
        design = load_design(preset)
    options = Options(
        preset=name,
        design=design,
        assume=assume,
        joints=loaded.joints,
        tip=loaded.tip,
        angle_tolerance=loaded.angle_tolerance,
        width=width,
        depth=depth,
    )
    spec = make_spec(loaded, options)
    if module is not None:
        spec = replace(spec, urdf=_way_to_urdf(module, loaded.robot.path))
    return emit(spec)


def rebuilt(facts: Facts, urdf: Path) -> str:
    """The text of the module that has these facts, written anew from a copy of its URDF. Raises as ``load_arm``."""
    spec = make_spec(arm_of_module(facts, urdf), facts.options)
    return emit(replace(spec, urdf=facts.urdf))


def make_spec(loaded: LoadedArm, options: Options) -> ModelSpec:
    """The spec of the module that ``options`` ask for."""
    return plan_model(
        loaded.arm,
        loaded.structure_for(options.assume),
        loaded.actuation,
        options,
        urdf=loaded.robot.path.name,
        urdf_sha256=loaded.robot.digest,
        drives={item.name: loaded.settings.joint(item.name) for item in loaded.arm.coordinates},
        servos=loaded.settings.input == "position",
    )


def require_own_module(module: Path, urdf: Path) -> None:
    """Raise RunError unless a run folder's module is what its facts and the URDF beside it give.

    A module is a program: it is run only where it is the very text that this version of spelgen writes.
    """
    source = read_source(module)
    facts = parse_facts(source, module)
    hint = ""
    try:
        if not urdf.is_file():
            hint = "; fit(arm=...) and train --robot keep one"
            reason = "there is no URDF beside it to write it anew from"
        elif rebuilt(facts, urdf) == source:
            return
        else:
            reason = "it is not what spelgen writes for the URDF beside it"
    except SpelgenError as error:
        reason = f"it cannot be written anew ({error})"
    raise RunError(
        f"a module that spelgen cannot verify: {reason}", file=module,
        do="read it, then pass --trust (in Python: trust=True), or build it again and start a new run" + hint,
    )  # fmt: skip


@dataclass(frozen=True)
class CheckResult:
    """Whether a module is what its URDF gives today; ``reasons`` say why it is not."""

    urdf: Path
    fresh: bool
    reasons: tuple[str, ...]
    proof: Verification


def check(module: str | Path, urdf: str | Path | None = None) -> CheckResult:
    """Generate the module at ``module`` again, with its own options, compare it, and test its structure numerically.

    Without ``urdf`` the URDF is looked for by name beside the module, in the current folder and in
    ``robots/``. Raises ModuleError when there is none or when the file is no emitted module.
    """
    module = Path(module)
    facts = read_facts(module)
    urdf_path = Path(urdf) if urdf is not None else find_urdf(module, facts.urdf)
    loaded = arm_of_module(facts, urdf_path)
    spec = replace(make_spec(loaded, facts.options), urdf=facts.urdf)
    reasons = []
    if spec.urdf_sha256 != facts.urdf_sha256:
        reasons.append(f"{urdf_path} has changed since the module was built")
    if spec.sha256 != facts.spec_sha256:
        reasons.append("the derived model differs from the one in the module")
    if emit(spec) != read_source(module):
        reasons.append("the module's text differs from what `spelgen build` writes now")
    proof = loaded.verify(facts.options.assume)
    reasons += [str(difference) for difference in proof.differences]
    return CheckResult(urdf_path, not reasons, tuple(reasons), proof)


def _way_to_urdf(module: Path, urdf: Path) -> str:
    """Return by what a module names its URDF: the file's name where `find_urdf` finds it, else the way to it."""
    try:
        if find_urdf(module, urdf.name).samefile(urdf):
            return urdf.name
    except ModuleError:
        pass
    return Path(os.path.relpath(urdf, module.parent)).as_posix()


def find_urdf(module: Path, name: str) -> Path:
    """The URDF called ``name`` near ``module``. Raises ModuleError."""
    folders = [module.parent, Path(), Path("robots"), module.parent / "robots"]
    for folder in folders:
        if (folder / name).is_file():
            return folder / name
    raise ModuleError(
        f"its URDF {name!r} is in none of " + ", ".join(dict.fromkeys(map(str, folders))),
        file=module,
        do="name it with --robot",
    )
