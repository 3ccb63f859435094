"""Entry point of the command line. Each command is one step from a URDF to a report.

A command imports its modules when it runs, so that `spelgen --help` is fast and `spelgen inspect` never imports torch.
"""

import gc
import os
import re
import signal
import sys
from collections.abc import Callable
from difflib import get_close_matches
from typing import Any

import typer
from typer.core import TyperArgument, TyperCommand, TyperGroup

from spelgen.cli.arm_commands import identify, inspect
from spelgen.cli.console import handle_errors, say
from spelgen.cli.evaluate_command import compare, estimate, evaluate, report
from spelgen.cli.log_commands import excite, logs, simulate
from spelgen.cli.model_commands import build, check, export, init
from spelgen.cli.train_command import train
from spelgen.version import __version__

BaseUsageError: type[Exception] = typer.BadParameter.__mro__[1]
"""Exception UsageError of click. Typer contains click as a private package, so it cannot be imported by name."""
CONTEXT = {"max_content_width": 80, "help_option_names": ["-h", "--help"]}


class Command(TyperCommand):
    """A command whose help shows arguments by name only, without the type that typer adds."""

    def get_help(self, ctx: Any) -> str:
        """Return the help text of the command."""
        # Typer would add the type, such as `PATH`, to arguments whose metavar states it already.
        for parameter in self.params:
            if isinstance(parameter, TyperArgument):
                vars(parameter)["display_type"] = lambda ctx: ""
        return super().get_help(ctx)

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the arguments of the usage line as texts: optional arguments in brackets, braces of typer removed."""
        return [re.sub(r"[{}]", "", piece) for piece in super().collect_usage_pieces(ctx)]


class CommandGroup(TyperGroup):
    """The group of all commands. A usage error suggests the nearest command, option or choice."""

    def invoke(self, ctx: Any) -> Any:
        """Run a command; a usage error names the nearest command, option or choice."""
        try:
            return super().invoke(ctx)
        except BaseUsageError as error:
            _suggest(error)
            raise


def _suggest(error: Any) -> None:
    """Add the nearest option or choice to the message of a usage error of click."""
    # Click lists all similar names of an unknown option or command; the message suggests only the first one.
    nearest = list(vars(error).get("possibilities") or [])[:1]
    if nearest:
        error.possibilities = []
    # Choices are checked by pydantic, which adds the prefix "Value error" to messages: it is removed.
    error.message = error.message.replace("Value error, ", "")
    # Click makes no suggestion for an invalid choice, so the choices are read from its message.
    choice = re.fullmatch(r"'(.*)' is not one of (.*)\.", error.message, re.DOTALL)
    if choice:
        choices = re.findall(r"'([^']*)'", choice[2])
        nearest = [repr(name) for name in get_close_matches(choice[1], choices, n=1)]
        error.message = f"{choice[1]!r} is none of {', '.join(choices)}."
    if nearest:
        error.message = f"{error.message.rstrip('.')}. Did you mean {nearest[0]}?"


app = typer.Typer(
    name="spelgen",
    cls=CommandGroup,
    context_settings=CONTEXT,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
# The commands have the order in which a first project needs them; `spelgen --help` lists them in this order.
COMMANDS: list[Callable[..., None]] = [inspect, init, build, simulate, identify, excite, logs]
COMMANDS += [train, evaluate, estimate, report, export, compare, check]
for command in COMMANDS:
    app.command(cls=Command, context_settings=CONTEXT)(handle_errors(command))


def _version(requested: bool) -> None:
    if requested:
        say(f"spelgen {__version__}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def common(
    ctx: typer.Context,
    version: bool = typer.Option(
        False, "--version", callback=_version, is_eager=True, help="Print the version and exit."
    ),
) -> None:
    """Derive, train and export dynamics models of robot arms from URDF files and logs."""
    # Without a command the help is printed and the exit code is 0; typer would exit with an error.
    if ctx.invoked_subcommand is None:
        say(ctx.get_help())


def main() -> None:
    """Entry point of the command `spelgen`."""
    # OMP_NUM_THREADS is set before BLAS and torch are imported, because both read the variable only once. One thread
    # makes runs deterministic, and is fastest for small matrices.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    # The signal SIGTERM ends a command as Ctrl-C does: unfinished files are removed.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    # Garbage collection is made rare: imports create many objects that live as long as the process, and collections
    # during imports take 6 % of the time of a short command.
    gc.set_threshold(100_000)
    for stream in (sys.stdout, sys.stderr):
        # A name from a file may contain characters that the terminal's encoding does not have: escapes are printed.
        stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    app(prog_name="spelgen")
