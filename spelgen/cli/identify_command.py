"""The command `identify`: least squares on logs, before or beside any network."""

from __future__ import annotations

import json
from typing import Annotated, Literal

import typer

from spelgen.cli import options
from spelgen.cli.console import note
from spelgen.cli.options import (
    Accept,
    AngleTolerance,
    Data,
    Filter,
    Joints,
    MappingFile,
    MoreData,
    Output,
    Robot,
    Tip,
)

Format = Literal["text", "json", "html"]
EFFECTS = ("stribeck", "polynomial", "memory")


def identify(
    robot: Robot,
    extra_logs: MoreData = None,
    data: Data = None,
    mapping: MappingFile = None,
    joints: Joints = None,
    tip: Tip = None,
    angle_tolerance: AngleTolerance = 2e-3,
    filter: Filter = None,
    weights: Annotated[
        Literal["equal", "range", "noise"],
        typer.Option(help="Weights of the joints: equal, by torque range, or by torque noise."),
    ] = "noise",
    friction: Annotated[
        str | None,
        typer.Option(
            metavar="stribeck,polynomial,memory",
            help="Friction terms beside viscous and Coulomb friction: Stribeck effect; qd |qd| and qd^3; bristles "
            "(hysteresis).",
        ),
    ] = None,
    accept: Accept = None,
    format: Annotated[Format | None, options.result_format()] = None,
    output: Output = None,
) -> None:
    """Identify base parameters and friction by least squares."""
    paths = options.logs(data, extra_logs)
    from spelgen.dynamics.friction import FrictionModel
    from spelgen.identification.identification import LeastSquares
    from spelgen.identification.identify import identify as identify_arm
    from spelgen.log_checks.check_logs import require_sound_logs
    from spelgen.logs.preprocessing import Preprocessing
    from spelgen.logs.read import read_logs

    # names and no flags: effects combine in any way
    effects = options.names(friction) or []
    for name in effects:
        if name not in EFFECTS:
            raise typer.BadParameter(f"{name!r} is none of {', '.join(EFFECTS)}", param_hint="'--friction'")
    method = LeastSquares(weights, FrictionModel(**dict.fromkeys(effects, True)))
    arm = options.load(robot, joints, tip, angle_tolerance)
    # codes are accepted for this command alone; the sidecar holds those for always
    log_mapping = options.log_mapping(arm, mapping, accept)
    logs = read_logs(paths, arm, log_mapping, role="train")
    # least squares would fit wrong units without a word
    for diagnostic in require_sound_logs(logs, arm, log_mapping):
        note(diagnostic)
    result = identify_arm(arm, logs, method, preprocessing=Preprocessing(cutoff=filter))
    for diagnostic in result.diagnostics:
        note(diagnostic)

    def page() -> str:
        # pages and charts are imported where they are asked for
        from spelgen.render.identification_page import page

        return page(result, arm)

    forms = {"text": result.text, "json": lambda: json.dumps(result.to_dict(), indent=2), "html": page}
    options.write_result(format, output, forms)
