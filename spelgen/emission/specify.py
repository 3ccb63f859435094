"""The functions ``make_spec`` (URDF to ``ModelSpec``), ``generate`` (URDF to a module's source), and ``find_urdf``."""

import os
from dataclasses import replace
from pathlib import Path

from spelgen.arm.configured_arm import Arm, load_arm
from spelgen.design import PRESET_NAMES, Design, load_design
from spelgen.errors import ModuleError
from spelgen.spec import ModelSpec, Options
from spelgen.urdf.robot import Assume


def generate(
    arm: Arm | str | Path,
    preset: str | Path | Design = "hybrid",
    *,
    width: int = 64,
    depth: int = 2,
    assume: Assume = "kinematics",
    standalone: bool = False,
    module: Path | None = None,
) -> str:
    """Return the source of the module tailored to an arm; arguments and errors as for `build`.

    Args:
        standalone: whether the module contains the runtime classes that it needs, so that it imports PyTorch only.
        module: path of the file that the source will be written to; the source has the URDF's path relative to this
            file.
    """
    from spelgen.emission.text import module_text

    spec = make_spec(arm, preset, width=width, depth=depth, assume=assume, module=module)
    return module_text(spec, standalone=standalone)


def make_spec(
    arm: Arm | str | Path,
    preset: str | Path | Design = "hybrid",
    *,
    width: int = 64,
    depth: int = 2,
    assume: Assume = "kinematics",
    module: Path | None = None,
) -> ModelSpec:
    """Return the specification of the model of an arm, from which a model or a module is made.

    module: path of the module; the specification then contains the path of the URDF relative to the module's folder.
    None: the specification contains only the file name of the URDF.
    Other arguments and errors as for ``build``.
    """
    # `derive_spec` is imported here, since importing it takes time: commands that read a specification do not need it.
    from spelgen.emission.plan import derive_spec

    arm = arm if isinstance(arm, Arm) else load_arm(arm)
    name, design = str(preset), None
    # The options contain the content of a user's design file, so that the module can be rebuilt without the
    # file.
    if preset not in PRESET_NAMES:
        name = "own" if isinstance(preset, Design) else Path(preset).stem
        design = load_design(preset)
    options = Options(
        preset=name,
        design=design,
        assume=assume,
        joints=arm.joints,
        tip=arm.tip,
        angle_tolerance=arm.angle_tolerance,
        width=width,
        depth=depth,
    )
    spec = derive_spec(arm, options)
    # The module contains a relative path of the URDF, so that a project folder with module and URDF can be moved.
    return spec if module is None else replace(spec, urdf=_path_of_urdf(module, arm.robot.path))


def arm_of_spec(spec: ModelSpec | None, urdf: str | Path) -> Arm:
    """Return the arm that a model was built for, read again from ``urdf`` with the options of the specification.

    The options are joints, tip and angle tolerance; their defaults are used if ``spec`` is None. Raises UrdfError,
    ArmError or SettingsError.
    """
    options = Options() if spec is None else spec.options
    return load_arm(urdf, options.joints, options.tip, options.angle_tolerance)


def find_urdf(module: Path, name: str) -> Path:
    """Return the path of the URDF of a module. Raises ModuleError if the URDF is not found.

    module: path of the module. name: name or relative path of the URDF in the module's specification. The URDF is
    searched in the module's folder, in the current folder, and in the subfolders robots/ of both.
    """
    # The folder of the module is searched first, since most projects have the URDF there.
    folders = [module.parent, Path(), Path("robots"), module.parent / "robots"]
    for folder in folders:
        if (folder / name).is_file():
            return folder / name
    raise ModuleError(
        f"its URDF {name!r} is in none of " + ", ".join(dict.fromkeys(map(str, folders))),
        file=module,
        do="name it with --robot",
    )


def _path_of_urdf(module: Path, urdf: Path) -> str:
    """Return the URDF's file name if ``find_urdf`` can find it; otherwise its path relative to the module's folder."""
    try:
        if find_urdf(module, urdf.name).samefile(urdf):
            return urdf.name
    except ModuleError:
        pass
    return Path(os.path.relpath(urdf, module.parent)).as_posix()
