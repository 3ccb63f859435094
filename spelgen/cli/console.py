"""Output of commands: results to stdout, one line per error to stderr, documented exit codes."""

import functools
import inspect
import json
import os
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import NoneType
from typing import NoReturn, get_args

import typer
from typer.models import OptionInfo

from spelgen.errors import SpelgenError, in_one_line
from spelgen.files import local, with_addresses, write_text
from spelgen.labels import counted, printable

METAVARS: dict[object, str] = {int: "N", float: "X", str: "TEXT", Path: "FILE"}
FAILED = 1
INTERRUPTED = 130  # exit code after Ctrl-C, as in shells: 128 + 2, the number of the signal SIGINT
BROKEN_PIPE = 141  # exit code if the reader of a pipe has ended: 128 + 13, the number of SIGPIPE

# {optional package: group of dependencies ("extra") of spelgen that installs it}, for the error if it is absent
EXTRAS = {"pinocchio": "simulate", "ray": "parallel"}
EXTRAS |= dict.fromkeys(("casadi", "mujoco", "onnxruntime", "onnxscript", "safetensors"), "deploy")

DEBUG = typer.Option(False, "--debug", help="Show the traceback of an error.")


def handle_errors(command: Callable[..., None]) -> Callable[..., None]:
    """Return the command with an additional option --debug; exceptions of the command are reported by `fail`.

    An argument of the command that is a dataclass is replaced by one option per field. Usage errors (exit code 2) are
    unchanged, because typer raises them before the command runs.
    """
    groups: dict[str, type] = {}
    options: list[inspect.Parameter] = []
    # With `from __future__ import annotations`, annotations are strings: `eval_str` converts them to types.
    for name, parameter in inspect.signature(command, eval_str=True).parameters.items():
        if isinstance(parameter.annotation, type) and is_dataclass(parameter.annotation):
            groups[name] = parameter.annotation
            options += inspect.signature(parameter.annotation, eval_str=True).parameters.values()
        else:
            options.append(parameter)
    options.append(inspect.Parameter("debug", parameter.KEYWORD_ONLY, default=DEBUG, annotation=bool))

    @functools.wraps(command)
    def run(*, debug: bool = False, **values: object) -> None:
        try:
            values = {name: _local(value) for name, value in values.items()}
            for name, group in groups.items():
                values[name] = group(**{field.name: values.pop(field.name) for field in fields(group)})
            command(**values)
            # The flush raises the error of a closed pipe here, where it is reported, and not at the exit of the
            # interpreter.
            sys.stdout.flush()
        except (typer.Exit, typer.Abort, typer.BadParameter):
            raise
        except BaseException as error:
            fail(error, debug=debug)

    for option in options:
        _name_values(option.annotation, option.default)
    # Typer reads the options of a command from the signature and annotations of its function: both are set for `run`.
    parameters = [option.replace(kind=inspect.Parameter.KEYWORD_ONLY) for option in options]
    vars(run)["__signature__"] = inspect.Signature(parameters)
    run.__annotations__ = {option.name: option.annotation for option in options}
    return run


def _name_values(annotation: object, info: object) -> None:
    """Set the placeholder of an option's value in the help.

    It is N for an integer, X for a float, TEXT, FILE for a path, or the list of the choices. annotation: type of the
    option's value. info: declaration of the option for typer, which is changed.
    """
    value_type = get_args(annotation)[0] if NoneType in get_args(annotation) else annotation
    if isinstance(info, OptionInfo) and info.metavar is None and value_type is not bool:
        info.metavar = METAVARS.get(value_type) or "|".join(map(str, get_args(value_type)))


def _local(value: object) -> object:
    """Return the value of an option, in which URLs (such as s3://bucket/log) are replaced by paths of local copies."""
    if isinstance(value, list):
        return [_local(element) for element in value]
    return local(value) if isinstance(value, Path) else value


def fail(error: BaseException, *, debug: bool = False) -> NoReturn:
    """Report an exception on stderr, and exit with its exit code. debug: if True, print the traceback first."""
    if isinstance(error, BrokenPipeError):
        # A closed pipe means that the reader of stdout has ended: no message is printed, and stdout becomes /dev/null,
        # so that the flush at the exit of the interpreter does not fail.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(BROKEN_PIPE)
    if debug:
        traceback.print_exception(error)
    # An interrupt (Ctrl-C) is no failure, and has an exit code of its own. If it arrives while a compiled module is
    # imported, the module raises an ImportError whose cause is the KeyboardInterrupt.
    if isinstance(error, KeyboardInterrupt) or isinstance(error.__cause__, KeyboardInterrupt):
        note("interrupted")
        raise typer.Exit(INTERRUPTED)
    note(_message(error, debug))
    raise typer.Exit(FAILED)


def _message(error: BaseException, debug: bool) -> str:
    if isinstance(error, SpelgenError):
        return str(error)
    package = (error.name or "") if isinstance(error, ModuleNotFoundError) else ""
    extra = EXTRAS.get(package.split(".")[0])
    if extra is not None:
        return f"this needs the package {package}, which is not installed; pip install 'spelgen[{extra}]'"
    # A full disk or a missing permission is not a defect of spelgen, so it is reported without a traceback.
    if isinstance(error, OSError) and (error.filename is not None or error.strerror):
        file = "" if error.filename is None else f"{os.fsdecode(error.filename)}: "
        return f"{file}{(error.strerror or type(error).__name__).lower()}"
    hint = "" if debug else "; --debug shows where"
    return f"spelgen: unexpected {in_one_line(error)}{hint}"


@contextmanager
def progress_bar(title: str) -> Iterator[Callable[..., None]]:
    """Context manager that shows a progress bar on stderr if stderr is a terminal.

    It yields a function f(done, total, title) that updates the bar: number of finished steps, number of all steps, and
    (optional) title of the current step.
    """
    from rich.console import Console
    from rich.progress import Progress

    # The progress bar is on stderr, because stdout contains only the result of the command.
    with Progress(console=Console(stderr=True), disable=not sys.stderr.isatty(), transient=True) as bar:
        task = bar.add_task(title, total=None)
        yield lambda done, total, now=title: bar.update(task, completed=done, total=total, description=now)


def say(text: str) -> None:
    """Print a result to stdout."""
    print(printable(with_addresses(text), "\n"))


def note(text: object) -> None:
    """Print a message to stderr: progress, a diagnostic or an error."""
    print(printable(with_addresses(str(text)), "\n"), file=sys.stderr, flush=True)


def answer(form: str, record: Mapping[str, object], *lines: str) -> None:
    """Print the result of a command.

    form: "text" prints `lines`, the result as lines of text; "json" prints `record`, the same result, as JSON.
    """
    # The JSON object is printed on one line, because log files of pipelines have one record per line.
    if form == "json":
        print(json.dumps(record, default=str))
        return
    for line in lines:
        say(line)


def deliver(text: str, output: Path | None) -> None:
    """Print a result without its last line end, or write it to the file `output` and print the path of the file."""
    if output is None:
        say(text.removesuffix("\n"))
    else:
        say(f"wrote {write_text(output, text)}")


def refuse_warnings(subject: str, count: int) -> None:
    """Exit with code 1 and a message about `subject` if `count`, the number of warnings, is not 0 (--strict)."""
    if count:
        note(f"{subject}{counted(count, 'warning')}, and --strict allows none")
        raise typer.Exit(FAILED)
