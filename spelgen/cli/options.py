"""Arguments and options that several commands share, and the conversion of their values.

An option is the default value of a parameter of a command; typer replaces it by the value from the command line.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, get_args

import typer

from spelgen.cli.console import deliver
from spelgen.errors import SpelgenError, suggestion
from spelgen.settings.log_mapping import Accepted

if TYPE_CHECKING:
    from spelgen.arm.configured_arm import Arm
    from spelgen.logs.arm_mapping import LoggedArm
    from spelgen.settings.log_mapping import LogMapping


Declared: TypeAlias = Any
"""Declaration of an option or argument, as the default value of a parameter of any type."""


class UsageError(typer.BadParameter):
    """Usage error about an option that does not apply; the message names the option."""

    def format_message(self) -> str:
        """Return the message without typer's prefix "Invalid value for ...": the message names the option."""
        return self.message


def option(
    metavar: str,
    text: str,
    *names: str,
    default: object = None,
    min: float | None = None,
    max: float | None = None,
) -> Declared:
    """Return the declaration of an option, which is the default value of a parameter of a command.

    Args:
        metavar: Placeholder of the value in the help; "": a placeholder for the type of the value.
        text: Help text.
        names: Names of the option, such as "-o"; by default the name of the parameter.
        default: Value if the option is not given; ... makes the option required.
        min: Smallest permitted value.
        max: Largest permitted value.
    """
    return typer.Option(default, *names, metavar=metavar or None, help=text, min=min, max=max)


def flag(name: str, text: str) -> Declared:
    """Return the declaration of an option without a value, and without the negation `--no-...` that typer would add."""
    return option("", text, name, default=False)


def argument(metavar: str, text: str, default: object = ...) -> Declared:
    """Return the declaration of a positional argument; `metavar` is its name in the help; it is required by default."""
    return typer.Argument(default, metavar=metavar, help=text)


def output_option(metavar: str, text: str, default: object = None) -> Declared:
    """Return the declaration of the option `-o` for an output file or folder; `metavar`: placeholder in the help."""
    return option(metavar, text, "-o", "--output", default=default)


SUFFIXES = {"": "text", ".txt": "text", ".json": "json", ".html": "html", ".py": "sympy"}
"""{suffix of an output file: format of its content}; a name without a suffix means text."""

TextOrJson = Literal["text", "json"]

ROBOT = argument("ROBOT.urdf", "URDF of the arm; settings are read from ROBOT.yaml beside it.")
ROBOT_OPTION = option("ROBOT.urdf", "URDF of the module, if it is not found by name.")
MODULE = argument("MODULE.py", "A module written by `spelgen build`.")
RUN = argument("RUN", "A run folder of `spelgen train`.")
JOINTS = option("A,B,C", "Moving joints; all others are locked at zero.")
TIP = option("LINK", "Last link of the chain, which starts at the root.")
ASSUMPTION = option(
    "",
    "URDF values the structure may use: kinematics, or also zeros and symmetries of inertials.",
    default="kinematics",
)
ANGLE_TOLERANCE = option(
    "RAD", "Tolerance for rounding angles to special values such as pi/2.", min=0.0, max=0.1, default=2e-3
)
ENTRY = option("ROW,COLUMN|V", "Write this entry of M, or V, as an expression.")
DATA = option("LOGS...", "Log files or folders.")
MORE_DATA = argument("LOGS", "More log files or folders; several may follow --data.", default=None)
MAPPING_FILE = option("FILE", "YAML file with column names and units of the logs; see docs/logs.md.")
ACCEPT = option("CODE", "Use logs in spite of the error with this code (docs/messages.md); once for each.")
TEXT_OR_JSON = option("", "Format of the result on stdout.", default="text")
FILTER = option("HZ", "Cutoff frequency of the zero-phase low-pass filter; 0: no filter.", min=0.0)
ADDRESS = option("HOST:PORT", "Address of a running Ray cluster; default: a new one on this machine.")
STRICT = flag("--strict", "Exit with 1 if there is any warning.")
FORCE = flag("--force", "Overwrite existing output.")
OUTPUT = output_option("FILE", "Write the result to a file.")


def result_format() -> Declared:
    """Return the option `--format` of a command; each command has its own formats, which its help lists."""
    return option("", "Format of the result; default: that of the suffix of -o, else text.")


def choose_format(format: str | None, output: Path | None, formats: Container[str]) -> str:
    """Return the format of a result: `format`, else the format for the suffix of the output file, else text.

    formats: formats of the command. Raises a usage error if the suffix belongs to none of these formats.
    """
    if format or output is None:
        return format or "text"
    suffixes = {suffix: name for suffix, name in SUFFIXES.items() if name in formats}
    if output.suffix.lower() not in suffixes:
        forms = ", ".join(filter(None, suffixes))
        message = f"{output.name!r} has no suffix of a format of this command: {forms}"
        raise typer.BadParameter(message, param_hint="'--output'")
    return suffixes[output.suffix.lower()]


def write_result(format: str | None, output: Path | None, forms: Mapping[str, Callable[[], str]]) -> None:
    """Print a result, or write it to a file. forms: {format: function that returns the result in this format}."""
    deliver(forms[choose_format(format, output, forms)]() + "\n", output)


def names(text: str | None) -> list[str] | None:
    """Return the names in a text separated by commas: `a, b, "c, d"` has three names. None is returned unchanged."""
    if text is None:
        return None
    # The text is parsed as CSV, because a quoted name may contain a comma.
    cells: list[str] = next(csv.reader([text], skipinitialspace=True), [])
    return [name.strip() for name in cells]


def numbers(text: str | None, option: str) -> list[float] | None:
    """Return the numbers in a text such as `0, 1.5`; None for None. Other texts: a usage error about `option`."""
    try:
        return None if text is None else [float(number) for number in text.split(",")]
    except ValueError:
        raise typer.BadParameter("write numbers with commas between them", param_hint=f"'{option}'") from None


def entry(text: str | None) -> tuple[int, int] | Literal["V"] | None:
    """Return the entry `3,2` of M as (3, 2), the potential `V` as "V", None as None. Raises a usage error otherwise."""
    if text is None:
        return None
    if text == "V":
        return "V"
    # Indices of an entry have at most four digits, because Python does not convert texts of thousands of digits.
    match = re.fullmatch(r"\s*(\d{1,4})\s*,\s*(\d{1,4})\s*", text, re.ASCII)
    if match is None:
        raise typer.BadParameter("name it as ROW,COLUMN or V", param_hint="'--entry'")
    return int(match[1]), int(match[2])


def logs(data: list[Path] | None, extra_logs: list[Path] | None) -> list[Path]:
    """Return the paths of all logs on the command line. Raises a usage error if there is no option --data."""
    # Logs are given by an option and not by an argument, so that they cannot be confused with a module.
    if not data:
        wrong = "write it before the logs" if extra_logs else "name at least one file or folder"
        raise typer.BadParameter(wrong, param_hint="'--data'")
    return [*data, *(extra_logs or [])]


def log_mapping(arm: LoggedArm, mapping: Path | LogMapping | None, codes: Sequence[str] | None) -> LogMapping:
    """Return the mapping of log columns, by default from the settings of the arm.

    codes: codes of errors in logs that are accepted in addition to the codes in the mapping. Raises a usage error for
    an unknown code.
    """
    from spelgen.logs.arm_mapping import log_source

    for code in codes or ():
        # An unknown code of --accept is an error: a misspelled code would accept nothing.
        if code not in get_args(Accepted):
            hint = suggestion(code, get_args(Accepted))
            raise typer.BadParameter(f"unknown code {code!r}; {hint}", param_hint="'--accept'")
    chosen = log_source(arm, mapping).mapping
    # The codes of log errors to accept, from the mapping and from --accept, are collected in a dict without duplicates.
    # A dict preserves their order, so that the record of a run is deterministic.
    accepted = dict.fromkeys((*chosen.accept, *(codes or ())))
    return chosen.model_copy(update={"accept": tuple(accepted)})


@dataclass(frozen=True)
class ArmOptions:
    """Arguments and options of commands that read an arm from a URDF."""

    robot: Path = ROBOT
    joints: str | None = JOINTS
    tip: str | None = TIP
    angle_tolerance: float = ANGLE_TOLERANCE

    def load(self) -> Arm:
        """Return the arm that these options select in the URDF."""
        from spelgen.arm.configured_arm import load_arm

        return load_arm(self.robot, names(self.joints), self.tip, self.angle_tolerance)


def require_free(path: Path, *, force: bool) -> None:
    """Raise SpelgenError if an output exists already and `force` is false."""
    if path.exists() and not force:
        do = "--force replaces it, -o names another"
        raise SpelgenError("this output exists already", file=path, do=do)
