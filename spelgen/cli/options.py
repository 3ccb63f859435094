"""Arguments and options of several commands, and the conversion of their values."""

from __future__ import annotations

import csv
import inspect
import re
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, get_args, get_type_hints

import typer
from typer.models import ArgumentInfo, OptionInfo

from spelgen.cli.console import deliver
from spelgen.errors import SpelgenError, suggestion
from spelgen.settings.log_mapping import Accepted
from spelgen.urdf.robot import Assume

if TYPE_CHECKING:
    from spelgen.arm.configured_arm import Arm
    from spelgen.logs.arm_mapping import LoggedArm
    from spelgen.settings.log_mapping import LogMapping


def option(
    metavar: str, text: str, *names: str, min: float | None = None, max: float | None = None
) -> OptionInfo:
    """Return an option. metavar: name of its value; "": by its type. names: default: the name of the parameter."""
    info: OptionInfo = typer.Option(*names, metavar=metavar or None, help=text, min=min, max=max)
    return info


def flag(name: str, text: str) -> OptionInfo:
    """Return an option without a value, and without the negation `--no-...` that typer would add."""
    return option("", text, name)


def argument(metavar: str, text: str) -> ArgumentInfo:
    """Return a positional argument."""
    info: ArgumentInfo = typer.Argument(metavar=metavar, help=text)
    return info


def output_option(metavar: str, text: str) -> OptionInfo:
    """Return the option `-o` of a command."""
    return option(metavar, text, "-o", "--output")


SUFFIXES = {".json": "json", ".csv": "csv", ".html": "html", ".tex": "latex", ".py": "sympy"}

Robot = Annotated[
    Path, argument("ROBOT.urdf", "URDF of the arm; settings are read from ROBOT.yaml beside it.")
]
RobotOption = Annotated[Path | None, option("ROBOT.urdf", "URDF of the module, if it is not found by name.")]
Module = Annotated[Path, argument("MODULE.py", "A module written by `spelgen build`.")]
Run = Annotated[Path, argument("RUN", "A run folder of `spelgen train`.")]
Joints = Annotated[str | None, option("A,B,C", "Moving joints; all others are locked at zero.")]
Tip = Annotated[str | None, option("LINK", "Last link of the chain, which starts at the root.")]
Assumption = Annotated[
    Assume,
    option("", "URDF values the structure may use: kinematics, or also zeros and symmetries of inertials."),
]
AngleTolerance = Annotated[
    float, option("RAD", "Tolerance for rounding angles to special values such as pi/2.", min=0.0, max=0.1)
]
Entry = Annotated[str | None, option("ROW,COLUMN|V", "Write this entry of M, or V, as an expression.")]
Data = Annotated[list[Path] | None, option("LOGS...", "Log files or folders.")]
MoreData = Annotated[
    list[Path] | None, argument("LOGS", "More log files or folders; several may follow --data.")
]
MappingFile = Annotated[
    Path | None, option("FILE", "YAML file with column names and units of the logs; see docs/logs.md.")
]
Accept = Annotated[
    list[str] | None, option("CODE", "Use logs with this error, which names its code; once for each.")
]
TextOrJson = Annotated[Literal["text", "json"], option("", "Format of the result on stdout.")]
Filter = Annotated[
    float | None, option("HZ", "Cutoff frequency of the zero-phase low-pass filter; 0: no filter.", min=0.0)
]
Address = Annotated[
    str | None, option("HOST:PORT", "Address of a running Ray cluster; default: a new one on this machine.")
]
Strict = Annotated[bool, flag("--strict", "Exit with 1 if there is any warning.")]
Force = Annotated[bool, flag("--force", "Overwrite existing output.")]


Output = Annotated[Path | None, output_option("FILE", "Write the result to a file.")]


def result_format() -> OptionInfo:
    """Return the option `--format` of a command; the formats depend on the command."""
    return option("", "Format of the result; default: that of the suffix of -o, else text.")


def choose_format(format: str | None, output: Path | None, formats: Container[str]) -> str:
    """Return the format, by default the format of the output's suffix if the command has it, else text."""
    # a suffix that the command has no format for is the user's choice of a name
    by_suffix = SUFFIXES.get(output.suffix.lower(), "text") if output else "text"
    return format or (by_suffix if by_suffix in formats else "text")


def write_result(format: str | None, output: Path | None, forms: Mapping[str, Callable[[], str]]) -> None:
    """Print or write a result; forms: functions that return its text, by format."""
    deliver(forms[choose_format(format, output, forms)]() + "\n", output)


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command whose arguments of a dataclass are given as the options that its fields declare."""
    parameters: list[inspect.Parameter] = []
    groups: dict[str, type] = {}
    declared = get_type_hints(command, include_extras=True)
    for name, parameter in inspect.signature(command).parameters.items():
        group = declared[name]
        if not (isinstance(group, type) and is_dataclass(group)):
            parameters.append(parameter.replace(kind=parameter.KEYWORD_ONLY, annotation=group))
            continue
        groups[name], options = group, get_type_hints(group, include_extras=True)
        for field in fields(group):
            annotation, default = options[field.name], field.default
            parameters.append(
                inspect.Parameter(field.name, parameter.KEYWORD_ONLY, default=default, annotation=annotation)
            )

    @wraps(command)
    def run(**values: object) -> None:
        for name, group in groups.items():
            values[name] = group(**{field.name: values.pop(field.name) for field in fields(group)})
        command(**values)

    # typer reads both
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    vars(run)["__signature__"] = inspect.Signature(parameters)
    return run


def names(text: str | None) -> list[str] | None:
    """Return `a, b, "c, d"` as three names, and None as None."""
    if text is None:
        return None
    # CSV, as a name in quotes may contain a comma
    cells: list[str] = next(csv.reader([text], skipinitialspace=True), [])
    return [name.strip() for name in cells]


def numbers(text: str | None, option: str) -> list[float] | None:
    """Return `0, 1.5` as two numbers, and None as None. Raises a usage error for any other text."""
    try:
        return None if text is None else [float(number) for number in text.split(",")]
    except ValueError:
        raise typer.BadParameter("write numbers with commas between them", param_hint=f"'{option}'") from None


def entry(text: str | None) -> tuple[int, int] | Literal["V"] | None:
    """Return `3,2` as (3, 2), `V` as "V" and None as None. Raises a usage error for any other text."""
    if text is None:
        return None
    if text == "V":
        return "V"
    # at most four digits: Python refuses to convert thousands of them, and no arm has as many joints
    match = re.fullmatch(r"\s*(\d{1,4})\s*,\s*(\d{1,4})\s*", text, re.ASCII)
    if match is None:
        raise typer.BadParameter("name it as ROW,COLUMN or V", param_hint="'--entry'")
    return int(match[1]), int(match[2])


def logs(data: list[Path] | None, extra_logs: list[Path] | None) -> list[Path]:
    """Return the paths of all options --data. Raises a usage error if there are none."""
    # an option and not an argument: logs and a module cannot be confused
    if not data:
        raise typer.BadParameter("name at least one file or folder", param_hint="'--data'")
    return [*data, *(extra_logs or [])]


def log_mapping(arm: LoggedArm, mapping: Path | LogMapping | None, codes: Sequence[str] | None) -> LogMapping:
    """Return the mapping of logs, by default the mapping in the arm's settings, with additional accepted errors.

    Raises a usage error for an unknown code.
    """
    from spelgen.logs.arm_mapping import log_source

    for code in codes or ():
        # a misspelt code would have no effect
        if code not in get_args(Accepted):
            hint = suggestion(code, get_args(Accepted))
            raise typer.BadParameter(f"unknown code {code!r}; {hint}", param_hint="'--accept'")
    chosen = log_source(arm, mapping).mapping
    # a dict preserves the order, so that the record of a run is deterministic
    accepted = dict.fromkeys((*chosen.accept, *(codes or ())))
    return chosen.model_copy(update={"accept": tuple(accepted)})


def load(robot: Path, joints: str | None, tip: str | None, angle_tolerance: float) -> Arm:
    """Return the arm of a URDF with the options of a command."""
    from spelgen.arm.configured_arm import load_arm

    return load_arm(robot, names(joints), tip, angle_tolerance)


def require_free(path: Path, *, force: bool) -> None:
    """Raise SpelgenError if an output exists already, unless `force` allows to replace it."""
    if path.exists() and not force:
        do = "--force replaces it, -o names another"
        raise SpelgenError("this output exists already", file=path, do=do)
