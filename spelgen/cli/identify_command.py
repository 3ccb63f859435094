"""The command `identify`: least squares on logs, before or beside any network."""

from __future__ import annotations

import json
from typing import Annotated, Literal

import typer

from spelgen.cli import options
from spelgen.cli.console import note, say
from spelgen.cli.options import AngleTolerance, Data, Filter, Joints, Mapping, MoreData, Output, Robot, Tip
from spelgen.errors import OptionError
from spelgen.files import write_text

Format = Literal["text", "json", "html"]


def identify(
    robot: Robot,
    more: MoreData = None,
    data: Data = None,
    mapping: Mapping = None,
    joints: Joints = None,
    tip: Tip = None,
    angle_tolerance: AngleTolerance = 2e-3,
    filter: Filter = None,
    weights: Annotated[
        Literal["equal", "range", "noise"],
        typer.Option(help="Of the joints: equal, or by their torque's range or noise."),
    ] = "noise",
    ridge: Annotated[
        float, typer.Option(min=0.0, help="Penalty on every parameter, relative to its column.")
    ] = 0.0,
    prior: Annotated[
        float | None, typer.Option(min=1e-6, help="Stay near the URDF's inertials; 0.5 suits few data.")
    ] = None,
    stribeck: Annotated[bool, typer.Option("--stribeck", help="Dry friction of slow motion.")] = False,
    polynomial: Annotated[bool, typer.Option("--polynomial", help="Friction in qd |qd| and qd^3.")] = False,
    memory: Annotated[
        bool, typer.Option("--memory", help="Dry friction by the way the joint came (bristles).")
    ] = False,
    coulomb_smoothing_velocity: Annotated[
        float, typer.Option(min=1e-6, help="Width of Coulomb friction's jump [rad/s, m/s].")
    ] = 0.01,
    format: Annotated[Format | None, options.result_format()] = None,
    output: Output = None,
) -> None:
    """Identify an arm's base parameters, friction and armature from logs by least squares."""
    paths = options.logs(data, more)
    from spelgen.identification.friction import FrictionModel
    from spelgen.identification.identify import identify as identified
    from spelgen.identification.method import LeastSquares
    from spelgen.loaded_arm import load_arm
    from spelgen.log_checks.check_logs import require_possible_torques
    from spelgen.logs.arm_mapping import log_source
    from spelgen.logs.preprocessing import Preprocessing
    from spelgen.logs.read import read_logs

    friction = FrictionModel(coulomb_smoothing_velocity, stribeck, polynomial, memory)
    try:
        method = LeastSquares(weights, ridge, prior, friction)
    except OptionError as error:
        raise typer.BadParameter(error.got, param_hint=f"'--{error.element}'") from None
    arm = load_arm(robot, options.names(joints), tip, angle_tolerance)
    logs = read_logs(paths, arm, mapping, role="train")
    require_possible_torques(logs, arm, log_source(arm, mapping).mapping)
    found = identified(arm, logs, method, preprocessing=Preprocessing(cutoff=filter))
    for each in found.diagnostics:
        note(f"{each.severity}: {each.where}: {each.message}")
    wanted = options.chosen(format, output, Format)
    if wanted == "html":
        from spelgen.render.identification_page import page

        result = page(found, arm)
    else:
        result = found.text() if wanted == "text" else json.dumps(found.to_dict(), indent=2)
    if output is None:
        say(result)
    else:
        say(f"wrote {write_text(output, result + chr(10))}")
