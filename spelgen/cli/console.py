"""How a command speaks: results to stdout, one line per error to stderr, exit codes to rely on."""

from __future__ import annotations

import functools
import inspect
import json
import os
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import NoneType
from typing import Annotated, NoReturn, get_args

import typer
from typer.models import OptionInfo

from spelgen.errors import SpelgenError, in_one_line
from spelgen.files import local, with_addresses, write_text
from spelgen.labels import counted, printable

METAVARS: dict[object, str] = {int: "N", float: "X", str: "TEXT", Path: "FILE"}
FAILED = 1
INTERRUPTED = 130  # 128 + SIGINT, as shells count
BROKEN_PIPE = 141  # 128 + SIGPIPE

# top-level module that only an extra brings -> the extra
EXTRAS = {
    "pinocchio": "simulate",
    "casadi": "deploy",
    "mujoco": "deploy",
    "onnxruntime": "deploy",
    "onnxscript": "deploy",
    "safetensors": "deploy",
    "ray": "parallel",
}

Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]


def handle_errors(command: Callable[..., None]) -> Callable[..., None]:
    """Wrap a command: it gains the option --debug, and its exceptions end as `fail` reports them.

    Typer finds usage errors (exit 2) before the command runs; they pass through.
    """

    @functools.wraps(command)
    def run(*arguments: object, debug: bool = False, **options: object) -> None:
        try:
            command(*arguments, **{name: _local(value) for name, value in options.items()})
            sys.stdout.flush()  # a closed pipe shows here, where it is handled, and not at exit
        except (typer.Exit, typer.Abort, typer.BadParameter):
            raise
        except BaseException as error:
            fail(error, debug=debug)

    # annotations are strings, as files begin with `from __future__ import annotations`
    signature = inspect.signature(command, eval_str=True)
    for parameter in signature.parameters.values():
        _name_values(*get_args(parameter.annotation))
    option = inspect.Parameter("debug", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=Debug)
    parameters = [*signature.parameters.values(), option]
    # typer reads the options from these two
    vars(run)["__signature__"] = signature.replace(parameters=parameters)
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


def _name_values(kind: object, *metadata: object) -> None:
    """Give an annotated option the name of its values that people read: N, X, FILE, or the choices."""
    kinds = [kind]
    if NoneType in get_args(kind):
        kinds = list(get_args(kind))
    for info in metadata:
        if isinstance(info, OptionInfo) and info.metavar is None and kind is not bool:
            info.metavar = METAVARS.get(kinds[0]) or "|".join(map(str, get_args(kinds[0])))


def _local(value: object) -> object:
    """Return paths that are addresses as their local copies, all else as it is."""
    if isinstance(value, list):
        return [_local(element) for element in value]
    if isinstance(value, Path):
        return local(value)
    return value


def fail(error: BaseException, *, debug: bool = False) -> NoReturn:
    """Report an exception on stderr and exit with its exit code; with `debug`, its traceback first."""
    if isinstance(error, BrokenPipeError):
        # Nobody listens any more: let the interpreter's last flush go nowhere, and say nothing.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(BROKEN_PIPE)
    if debug:
        traceback.print_exception(error)
    if isinstance(error, KeyboardInterrupt):
        # no traceback: whoever pressed Ctrl-C knows why it ended
        note("interrupted")
        raise typer.Exit(INTERRUPTED)
    note(_message(error, debug))
    raise typer.Exit(FAILED)


def _message(error: BaseException, debug: bool) -> str:
    if isinstance(error, SpelgenError):
        return str(error)
    if isinstance(error, ModuleNotFoundError):
        extra = EXTRAS.get((error.name or "").split(".")[0])
        if extra is not None:
            return (
                f"this needs the package {error.name}, which is not installed; pip install 'spelgen[{extra}]'"
            )
    # disks that are full and folders without permission are no defects of spelgen
    if isinstance(error, OSError) and error.filename is not None:
        return f"{os.fsdecode(error.filename)}: {(error.strerror or type(error).__name__).lower()}"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.lower()
    hint = "" if debug else "; --debug shows where"
    return f"spelgen: unexpected {in_one_line(error)}{hint}"


@contextmanager
def progress_bar(title: str) -> Iterator[Callable[..., None]]:
    """Show a bar on stderr, where that is a terminal.

    Gives a function to call with (done, all), and with a title of what runs now.
    """
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), disable=not sys.stderr.isatty(), transient=True) as bar:
        task = bar.add_task(title, total=None)
        yield lambda done, total, now=title: bar.update(task, completed=done, total=total, description=now)


def say(text: str) -> None:
    """Print a result to stdout."""
    print(printable(with_addresses(text), "\n"))


def note(text: object) -> None:
    """Print progress, a diagnostic or an error to stderr."""
    print(printable(with_addresses(str(text)), "\n"), file=sys.stderr, flush=True)


def answer(form: str, record: Mapping[str, object], *lines: str) -> None:
    """Print the result of a command: its lines for people, or its record as one line of JSON."""
    if form == "json":
        print(json.dumps(record, default=str))
        return
    for line in lines:
        say(line)


def deliver(text: str, output: Path | None) -> None:
    """Print a result without its last line end, or write it to a file and say so."""
    if output is None:
        say(text.removesuffix("\n"))
    else:
        say(f"wrote {write_text(output, text)}")


def refuse_warnings(subject: str, count: int) -> None:
    """Exit with 1 if there are warnings and --strict allows none."""
    if count:
        note(f"{subject}{counted(count, 'warning')}, and --strict allows none")
        raise typer.Exit(FAILED)
