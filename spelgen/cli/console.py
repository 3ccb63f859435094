"""How a command speaks: results to stdout, one line per error to stderr, exit codes to rely on."""

from __future__ import annotations

import functools
import inspect
import os
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from spelgen.addresses import local, with_addresses
from spelgen.cli.command import readable
from spelgen.errors import SpelgenError
from spelgen.labels import printable

FAILED = 1
INTERRUPTED = 130  # 128 + SIGINT, as shells count
BROKEN_PIPE = 141  # 128 + SIGPIPE

EXTRAS = {
    "pinocchio": "simulate",
    "casadi": "deploy",
    "optuna": "fleet",
    **dict.fromkeys(("mujoco", "onnx", "onnxruntime", "safetensors"), "deploy"),
}  # top-level module that only an extra brings -> the extra

Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]


def told(command: Callable[..., None]) -> Callable[..., None]:
    """Wrap a command: it gains the option --debug, and its exceptions end as `fail` tells them.

    Usage errors (exit 2) are found by typer before the command runs and pass through.
    """

    @functools.wraps(command)
    def run(*args: Any, debug: bool = False, **kwargs: Any) -> None:
        try:
            command(*args, **{name: _local(value) for name, value in kwargs.items()})
            sys.stdout.flush()  # a closed pipe shows here, where it is handled, and not at exit
        except (typer.Exit, typer.Abort, typer.BadParameter):
            raise
        except BaseException as error:
            fail(error, debug=debug)

    signature = inspect.signature(command, eval_str=True)
    for each in signature.parameters.values():
        readable(each.annotation)
    option = inspect.Parameter("debug", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=Debug)
    run.__signature__ = signature.replace(parameters=[*signature.parameters.values(), option])  # type: ignore[attr-defined]
    run.__annotations__ = {
        name: each.annotation for name, each in [*signature.parameters.items(), ("debug", option)]
    }
    return run


def _local(value: Any) -> Any:
    """Paths that are addresses become their local copies."""
    if isinstance(value, list):
        return [_local(each) for each in value]
    return local(value) if isinstance(value, Path) else value


def fail(error: BaseException, *, debug: bool = False) -> NoReturn:
    """Tell an exception on stderr and leave with its exit code; with `debug`, its traceback first."""
    if isinstance(error, BrokenPipeError):
        # Nobody listens any more: let the interpreter's last flush go nowhere, and say nothing.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(BROKEN_PIPE)
    if debug:
        traceback.print_exception(error)
    if isinstance(error, KeyboardInterrupt):
        note("interrupted")
        raise typer.Exit(INTERRUPTED)
    note(_told(error, debug))
    raise typer.Exit(FAILED)


def _told(error: BaseException, debug: bool) -> str:
    if isinstance(error, SpelgenError):
        return str(error)
    if isinstance(error, ModuleNotFoundError) and (error.name or "").split(".")[0] in EXTRAS:
        extra = EXTRAS[(error.name or "").split(".")[0]]
        return f"this needs the package {error.name}, which is not installed; pip install 'spelgen[{extra}]'"
    if isinstance(error, OSError) and error.filename is not None:
        return f"{os.fsdecode(error.filename)}: {(error.strerror or type(error).__name__).lower()}"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.lower()
    where = "" if debug else "; --debug shows where"
    return f"spelgen: unexpected {type(error).__name__}: {' '.join(str(error).split())}{where}"


@contextmanager
def counted(what: str) -> Iterator[Callable[[int, int], None]]:
    """A bar on stderr, where that is a terminal; gives a function to call with (done, all)."""
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), disable=not sys.stderr.isatty(), transient=True) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def say(text: str) -> None:
    """Print a result to stdout."""
    print(printable(with_addresses(text), "\n"))


def note(text: str) -> None:
    """Print progress, a remark or an error to stderr."""
    print(printable(with_addresses(text), "\n"), file=sys.stderr, flush=True)
