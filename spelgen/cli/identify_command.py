"""The command `identify`: least squares on logs, before or beside any network."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from spelgen.cli import options
from spelgen.cli.console import note, say
from spelgen.cli.options import Data, Joints, Mapping, MoreData, Robot, SnapTolerance, Tip
from spelgen.files import write_text

if TYPE_CHECKING:
    from spelgen.identification.samples import DynamicsSamples
    from spelgen.logs.read import Trajectory
    from spelgen.pipeline import Loaded


def identify(
    robot: Robot,
    more: MoreData = None,
    data: Data = None,
    mapping: Mapping = None,
    joints: Joints = None,
    tip: Tip = None,
    snap_tol: SnapTolerance = 2e-3,
    weights: Annotated[
        Literal["equal", "range", "noise"],
        typer.Option("--weights", help="Of the joints: equal, or by their torque's range or noise."),
    ] = "noise",
    ridge: Annotated[
        float, typer.Option("--ridge", min=0.0, help="Penalty on every parameter, relative to its column.")
    ] = 0.0,
    prior: Annotated[
        float | None,
        typer.Option("--prior", min=1e-6, help="Stay near the URDF's inertials; 0.5 suits few data."),
    ] = None,
    stribeck: Annotated[bool, typer.Option("--stribeck", help="Dry friction that fades with speed.")] = False,
    polynomial: Annotated[bool, typer.Option("--polynomial", help="Friction in qd |qd| and qd^3.")] = False,
    dry_velocity: Annotated[
        float, typer.Option("--dry-velocity", min=1e-6, help="Width of Coulomb friction's jump [rad/s, m/s].")
    ] = 0.01,
    format: Annotated[Literal["text", "json"], typer.Option("--format", help="Of the result.")] = "text",
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="Write to a file.")
    ] = None,
) -> None:
    """Identify an arm's base parameters, friction and rotors from logs by least squares."""
    paths = options.logs(data, more)
    if ridge and prior is not None:
        raise typer.BadParameter("--ridge or --prior, not both", param_hint="'--prior'")
    if prior is not None and weights != "noise":
        raise typer.BadParameter("--prior weighs by noise", param_hint="'--weights'")
    from spelgen import pipeline
    from spelgen.identification import formatting
    from spelgen.identification.friction import FrictionModel
    from spelgen.identification.identify import Method
    from spelgen.identification.identify import identify as identified
    from spelgen.logs.read import read_logs

    loaded = pipeline.load(robot, options.names(joints), tip, snap_tol)
    names = [coordinate.name for coordinate in loaded.arm.coordinates]
    kinds = [coordinate.kind for coordinate in loaded.arm.coordinates]
    named = options.mapping(mapping, robot, names)
    samples = _samples(read_logs(paths, names, role="train", mapping=named, joint_types=kinds), loaded)
    method = Method(weights, ridge, prior, FrictionModel(dry_velocity, stribeck, polynomial))
    found = identified(loaded.arm, samples, method)
    result = formatting.text(found) if format == "text" else json.dumps(formatting.to_dict(found), indent=2)
    if output is None:
        say(result)
    else:
        say(f"wrote {write_text(output, result + chr(10))}")


def _samples(trajectories: list[Trajectory], loaded: Loaded) -> list[DynamicsSamples]:
    """Moving samples with joint torques, whatever the logs' torques act on; odd logs are told."""
    from dataclasses import replace

    from spelgen.identification.samples import dynamics_samples
    from spelgen.logs.checks import examine

    coordinates = loaded.arm.coordinates
    for each in examine(trajectories, [c.name for c in coordinates], [c.kind for c in coordinates]):
        note(f"{each.severity}: {each.where}: {each.message}")
    samples = dynamics_samples(trajectories)
    left = {x.name for x in trajectories} - {x.name for x in samples}
    if left:
        note(f"warning: sampled too slowly or too short for accelerations: {', '.join(sorted(left))}")
    inputs = loaded.actuation.matrix()
    return [replace(x, tau=x.tau @ inputs.T) for x in samples]
