"""The command line: each command is one step of the way from a URDF to a report.

Imports stand inside the commands, so that `spelgen --help` is instant and `spelgen inspect` never loads torch.
"""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from spelgen import __version__
from spelgen.console import FAILED, note, say, told
from spelgen.errors import ModuleError, RunError, SpelgenError
from spelgen.files import write_text
from spelgen.spec import Assume, Preset, read_header

if TYPE_CHECKING:
    from spelgen.training_data import TrainingConfig

app = typer.Typer(
    name="spelgen",
    help="URDF in, a PyTorch model of the arm's dynamics with its exact structure out.",
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

Robot = Annotated[Path, typer.Argument(metavar="ROBOT.urdf", help="The arm's URDF; settings beside it are read too.")]
Joints = Annotated[
    str | None, typer.Option("--joints", metavar="A,B,C", help="The moving joints; all others are locked at zero.")
]
Tip = Annotated[str | None, typer.Option("--tip", metavar="LINK", help="The chain from the root to this link.")]
Assumption = Annotated[
    Assume,
    typer.Option("--assume", help="Believe only the kinematics, or also the zeros and symmetries of the inertials."),
]
SnapTolerance = Annotated[
    float,
    typer.Option("--snap-tol", metavar="RAD", min=0.0, max=0.1, help="Angles this close to a special one are that one."),
]
Force = Annotated[bool, typer.Option("--force", help="Replace an existing output.")]
Data = Annotated[
    list[Path], typer.Option("--data", metavar="LOGS...", help="Logs: files or folders of Parquet or CSV.", show_default=False)
]
MoreData = Annotated[
    list[Path] | None, typer.Argument(metavar="LOGS", help="More logs: --data may be followed by several.")
]


def _version(asked: bool) -> None:
    if asked:
        say(f"spelgen {__version__}")
        raise typer.Exit


@app.callback()
def common(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """URDF in, a PyTorch model of the arm's dynamics with its exact structure out."""


@app.command()
@told
def inspect(
    robot: Robot,
    joints: Joints = None,
    tip: Tip = None,
    assume: Assumption = "kinematics",
    snap_tol: SnapTolerance = 2e-3,
    format: Annotated[Literal["text", "json"], typer.Option("--format", help="How the result is written.")] = "text",
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="FILE", help="Write to this file.")] = None,
    strict: Annotated[bool, typer.Option("--strict", help="Exit with 1 if there is any warning.")] = False,
) -> None:
    """Tell the exact structure of an arm's dynamics: what is zero, constant, varying."""
    from spelgen import pipeline

    found = pipeline.inspect(robot, joints=_names(joints), tip=tip, assume=assume, snap_tolerance=snap_tol)
    text = found.text(width=80) if format == "text" else json.dumps(found.to_dict(), indent=2)
    if output is None:
        say(text)
    else:
        write_text(output, text.rstrip("\n") + "\n")
        note(f"wrote {output}")
    warnings = sum(diagnostic.severity == "warning" for diagnostic in found.diagnostics)
    if strict and warnings:
        note(f"{robot}: {warnings} {'warning' if warnings == 1 else 'warnings'}, and --strict allows none")
        raise typer.Exit(FAILED)


@app.command()
@told
def build(
    robot: Robot,
    joints: Joints = None,
    tip: Tip = None,
    assume: Assumption = "kinematics",
    snap_tol: SnapTolerance = 2e-3,
    preset: Annotated[Preset, typer.Option("--preset", help="How much structure the model has.")] = "minimal",
    width: Annotated[int, typer.Option("--width", min=1, max=4096, help="Hidden units of a network's layer.")] = 64,
    depth: Annotated[int, typer.Option("--depth", min=1, max=16, help="Hidden layers of a network.")] = 2,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="MODULE.py", help="Default: <robot>_model.py here.")
    ] = None,
    force: Force = False,
) -> None:
    """Write the PyTorch module tailored to an arm."""
    from spelgen import pipeline

    source = pipeline.build(
        robot, joints=_names(joints), tip=tip, assume=assume, snap_tolerance=snap_tol, preset=preset, width=width, depth=depth
    )
    path = output or Path(f"{robot.stem}_model.py")
    if path.is_file() and path.read_text(encoding="utf-8", errors="replace") == source:
        say(f"{path} is up to date")
        return
    _require_free(path, force)
    write_text(path, source)
    say(f"wrote {path}")


@app.command()
@told
def simulate(
    robot: Robot,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="LOGS", help="Folder for train and test logs.")],
    joints: Joints = None,
    tip: Tip = None,
    seed: Annotated[int | None, typer.Option("--seed", min=0, help="Of positions and inputs; default: the settings'.")] = None,
    force: Force = False,
) -> None:
    """Make training and test logs of an arm, with Pinocchio as the engine."""
    raise NotImplementedError


@app.command()
@told
def train(
    module: Annotated[Path, typer.Argument(metavar="MODULE.py", help="A module written by `spelgen build`.")],
    more: MoreData = None,
    data: Data = [],  # noqa: B006
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="RUN", help="Run folder; default: runs/<module>.")] = None,
) -> None:
    """Train a module on logs."""
    raise NotImplementedError


def _names(text: str | None) -> list[str] | None:
    """`a,b,"c,d"` -> the three names."""
    return None if text is None else [name.strip() for name in next(csv.reader([text], skipinitialspace=True), [])]


def _require_free(path: Path, force: bool) -> None:
    if path.exists() and not force:
        raise SpelgenError("this output exists already", file=path, do="--force replaces it, -o names another")


def main() -> None:
    """Entry point of the command `spelgen`."""
    for stream in (sys.stdout, sys.stderr):
        stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]  # names may not fit the terminal's encoding
    app(prog_name="spelgen")
