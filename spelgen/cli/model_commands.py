"""Commands about models: `init`, `build`, `check`, `export`."""

import json
from dataclasses import asdict
from pathlib import Path

import typer

from spelgen.cli import options
from spelgen.cli.console import FAILED, answer, note, say
from spelgen.cli.options import argument, flag, option, output_option
from spelgen.design import PRESET_NAMES
from spelgen.exporting.exported import Format
from spelgen.files import write_text
from spelgen.labels import UNITS
from spelgen.urdf.robot import Assume


def init(
    robot: Path = options.ROBOT,
    joints: str | None = options.JOINTS,
    tip: str | None = options.TIP,
    output: Path | None = output_option("FILE.yaml", "Output file; default: ROBOT.yaml beside the URDF."),
    force: bool = options.FORCE,
) -> None:
    """Write a commented file of settings for an arm."""
    from spelgen.arm.arm import make_arm
    from spelgen.templates import render
    from spelgen.urdf.read import read_urdf

    path = output or robot.with_suffix(".yaml")
    options.require_free(path, force=force)
    # The arm is made without a settings file, because this command writes it.
    arm = make_arm(read_urdf(robot), joints=options.names(joints), tip=tip)
    # Damping and friction of the URDF are the initial values in the file, which the user edits.
    text = render(
        "settings.yaml.jinja",
        urdf=robot.name,
        joints=arm.coordinates,
        names=arm.joint_names,
        tip=arm.bodies[-1].link,
        units=UNITS,
        json=json.dumps,
    )
    say(f"wrote {write_text(path, text)}")


def build(
    chosen_arm: options.ArmOptions,
    assume: Assume = options.ASSUMPTION,
    preset: str = option(
        "NAME|FILE.yaml", f"Preset of the model: {', '.join(PRESET_NAMES)}, or a YAML file.", default="hybrid"
    ),
    width: int = option("", "Hidden units per layer.", min=1, max=4096, default=64),
    depth: int = option("", "Number of hidden layers.", min=1, max=16, default=2),
    standalone: bool = flag("--standalone", "Include the runtime: the module then needs PyTorch only."),
    output: Path | None = output_option("MODULE.py", "Output file; default: <robot>_spel.py in this folder."),
    force: bool = options.FORCE,
    format: options.TextOrJson = options.TEXT_OR_JSON,
) -> None:
    """Write the PyTorch module tailored to an arm."""
    # The preset is checked first, because reading the URDF takes time.
    if preset not in PRESET_NAMES and Path(preset).suffix not in (".yaml", ".yml"):
        message = f"{preset!r} is none of {', '.join(PRESET_NAMES)}, nor a YAML file"
        raise typer.BadParameter(message, param_hint="'--preset'")
    from spelgen.emission.specify import make_spec
    from spelgen.emission.text import module_text

    arm = chosen_arm.load()
    path = output or Path(f"{chosen_arm.robot.stem}_spel.py")
    spec = make_spec(arm, preset, width=width, depth=depth, assume=assume, module=path)
    source = module_text(spec, standalone=standalone)
    # An unchanged file is not written, so that its modification time is kept.
    is_new = not path.is_file() or path.read_bytes() != source.encode()
    line = f"{path} is up to date"
    if is_new:
        options.require_free(path, force=force)
        line = f"wrote {write_text(path, source)}"
    if not spec.started_from_urdf:
        note(
            "the URDF has no physically consistent inertials of all moving bodies: each body starts with 1 kg"
        )
    record: dict[str, object] = {"module": str(path), "new": is_new, "robot": spec.robot, "urdf": spec.urdf}
    record |= {"urdf_sha256": spec.urdf_sha256, "spec_sha256": spec.sha256, "options": asdict(spec.options)}
    record |= {"joints": spec.joint_names, "joint_types": spec.joint_types}
    answer(format, record, line)


def check(module: Path = options.MODULE, robot: Path | None = options.ROBOT_OPTION) -> None:
    """Check whether a module is up to date with its URDF."""
    from spelgen.certificate.module_check import check as check_module

    result = check_module(module, robot)
    for reason in result.reasons:
        note(f"{module}: {reason}")
    if not result.fresh:
        note(f"{module}: build it again from {result.urdf}")
        raise typer.Exit(FAILED)
    proof = f"{len(result.proof.checks)} facts proved by {result.proof.means}"
    say(f"{module} is up to date with {result.urdf}; {proof}")


def export(
    run: Path = argument("RUN", "A folder that `spelgen train` wrote."),
    output: Path = output_option("FILE|FOLDER", "Output file or folder.", default=...),
    to: Format | None = option("", "Export format. Default: by the extension of the output."),
    entry: list[str] | None = option(
        "NAME",
        "A function to export, for c, casadi, onnx and torch; repeatable. Default: all.",
    ),
    float32: bool = flag("--float32", "Numbers of onnx and torch programs; otherwise float64."),
    force: bool = options.FORCE,
    format: options.TextOrJson = options.TEXT_OR_JSON,
) -> None:
    """Export a trained model to other tools. Each export is compared with the model before it is written.

    urdf: the rigid bodies; for models with networks in M, rigid bodies that are fitted to M and gravity torque of the
    model. mjcf: rigid bodies, drives and friction for MuJoCo. c: a C99 header and source without dependencies. ros2: a
    colcon package of the C header and source. casadi, onnx, torch: a file for each function.
    """
    from spelgen.exporting.export import export as export_run
    from spelgen.exporting.exported import format_by_extension, require_fitting

    # By default the suffix of the output file selects the format of the export.
    if to is None:
        to = format_by_extension(output)
    # The name of the output is checked first, because loading the model takes seconds.
    require_fitting(to, output)
    options.require_free(output, force=force)
    result = export_run(run, to, entries=entry or (), float32=float32)
    # `export_run` has compared the export with the model. If they differ, it raises an error and nothing is written.
    files = [str(path) for path in result.write(output, force=force)]
    lines = [f"wrote {path}" for path in files]
    answer(format, {"files": files, "summary": result.summary}, *lines, *result.summary)
