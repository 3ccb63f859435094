"""The command line: each command is one step of the way from a URDF to a report.

Commands import what they need when they run, so that `spelgen --help` is instant and `spelgen inspect`
never loads torch.
"""

from __future__ import annotations

import os
import sys
from typing import Annotated

import typer

from spelgen.cli import (
    evaluate_command,
    identify_command,
    inspect_command,
    log_commands,
    model_commands,
    study_commands,
    train_command,
)
from spelgen.cli.command import Command, Group
from spelgen.cli.console import handle_errors, say
from spelgen.version import __version__

CONTEXT = {"max_content_width": 80, "help_option_names": ["-h", "--help"]}

app = typer.Typer(
    name="spelgen",
    cls=Group,
    context_settings=CONTEXT,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
for command in (
    inspect_command.inspect,
    model_commands.init,
    model_commands.build,
    log_commands.simulate,
    identify_command.identify,
    log_commands.excite,
    log_commands.logs,
    train_command.train,
    evaluate_command.evaluate,
    evaluate_command.report,
    model_commands.export,
    study_commands.compare,
    study_commands.fleet,
    model_commands.check,
):
    app.command(cls=Command, context_settings=CONTEXT)(handle_errors(command))


def _version(requested: bool) -> None:
    if requested:
        say(f"spelgen {__version__}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def common(
    ctx: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Derive, train and export dynamics models of robot arms from URDF files and logs."""
    if ctx.invoked_subcommand is None:
        say(ctx.get_help())


def main() -> None:
    """Entry point of the command `spelgen`."""
    # read by BLAS and torch when they are loaded: matrices are tiny, and one thread makes runs repeatable
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    for stream in (sys.stdout, sys.stderr):
        # names from a file may not fit the terminal's encoding
        stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    app(prog_name="spelgen")
