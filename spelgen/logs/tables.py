"""Common result of all readers of logs: a table, and its layout, which states the column of each quantity and joint."""

import json
import re
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain, starmap
from pathlib import Path
from typing import Any, NamedTuple, Self

import pyarrow as pa

from spelgen.errors import LogError, shortened
from spelgen.logs.tuning import TUNING
from spelgen.settings.log_mapping import LogMapping, mapped_unit

UNITS_KEY = b"units"  # key of the units in a Parquet file's metadata
# Codes of the checks of units, which are omitted if a file declares its units.
UNIT_CODES = ("degrees", "time-unit", "torque-unit", "torque-beyond-drive")
STATED_KEY = b"stated units"  # key of {column: unit} in a table's metadata, from a line below a header
JOINTS_KEY = b"joints"  # key, in a table's metadata, of the joint names in the order of the columns `q[0]`, `q[1]`, ...
UNITS = b"t s, q rad or m, qd rad/s or m/s, tau Nm or N"  # units declared in logs that spelgen writes

LFS = b"version https://git-lfs"  # first bytes of a file whose content Git LFS has not fetched
# Types of the errors that Arrow, NumPy and zipfile raise for damaged files.
UNREADABLE = (
    pa.ArrowException, OSError, ValueError, EOFError, RuntimeError, MemoryError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip


@dataclass(frozen=True)
class Layout:
    """Layout of a log table: the columns that contain the quantities of an arm, and the mapping with their units.

    Attributes:
        file: path of the log; errors and trajectories contain it.
        columns: names of the columns of t, of q of all joints, of qd of all joints, and of tau of all joints; without
            qd if velocities are differentiated, and with u (commanded positions of servos) instead of qd and tau for
            logs of commands.
        labels: column with the names of recordings; None if the table has none.
        joints: names of the joints in the URDF.
        mapping: mapping of the columns, with units, signs and offsets.
        accepted: codes of checks whose findings the user has accepted; they are not run.
        recording: name of the recording if the file has several and the table contains only one; otherwise None.
        remarks: messages about properties of the file.
        header: number of lines before the values; None if the file does not consist of lines.
    """

    file: Path
    columns: tuple[str, ...]
    labels: str | None
    joints: tuple[str, ...]
    mapping: LogMapping
    accepted: tuple[str, ...]
    recording: str | None = None
    remarks: tuple[str, ...] = ()
    header: int | None = None

    def row_error(self, got: str, row: int, column: str, expected: str, do: str | None = None) -> LogError:
        """Return an error about the value in a row (from 0) and column; for a text file it also states the line.

        got, expected, do: arguments of `LogError`.
        """
        line = int(row) + 1 + self.header if self.header is not None else None
        element = f"row {row + 1}, column {column}"
        return LogError(got, file=self.file, line=line, element=element, expected=expected, do=do)


class LogTable(NamedTuple):
    """Columns of a log with unchanged values, the common result of the readers of all formats.

    Attributes:
        schema: names of the columns; also their types and metadata, if they are known before values are read.
        read: function that returns a table with the given columns; None: with all columns.
        mapping: mapping of the columns.
        remarks, header, recording: see `Layout`.
    """

    schema: pa.Schema
    read: Callable[[list[str] | None], pa.Table]
    mapping: LogMapping
    remarks: tuple[str, ...] = ()
    header: int | None = None
    recording: str | None = None

    @classmethod
    def of(cls, table: pa.Table, mapping: LogMapping, **properties: Any) -> Self:
        """Return the log table for an Arrow table in memory.

        properties: values of the attributes `remarks`, `header` and `recording`.
        """
        return cls(table.schema, lambda names: table, mapping, **properties)


class LogFormat(NamedTuple):
    """Format of logs: its files, and its reader.

    Attributes:
        read: reader (path, joint names, mapping) -> tables of a log; it raises LogError for a damaged log.
        suffixes: suffixes of files in this format.
        marker: path of a file that identifies a folder as a log of this format; "" if logs are single files.
        folder: description of such a folder, for messages.
    """

    read: Callable[[Path, Sequence[str], LogMapping], list[LogTable]]
    suffixes: tuple[str, ...] = ()
    marker: str = ""
    folder: str = ""


SERVO_ADVICE = (
    "write 'input: position' into the YAML beside the URDF if these are commands of position servos, "
    "or map them as tau"
)


def table_layout(log: LogTable, joints: Sequence[str], file: Path) -> Layout:
    """Return the layout of a log table: the column of each quantity and joint, by the mapping.

    Raises LogError if a column is missing or occurs twice.

    Files that spelgen wrote have SI units and default column names. Of the mapping, only the input (torque or
    position), the codes of checks to omit (``accept``) and the wraps of angles apply to them.
    """
    schema, mapping = log.schema, log.mapping
    metadata = schema.metadata or {}
    # Files of spelgen, e.g. simulated logs, are in SI units, even if the arm's mapping describes another logger.
    if metadata.get(UNITS_KEY) == UNITS:
        mapping = mapping.in_si()
    columns = [mapping.columns.t, *starmap(mapping.column, mapping.signals(joints))]
    for name in columns:
        element = f"column {name}"
        if columns.count(name) > 1:
            got, expected = "one column for several joints", "'{joint}' in its name under 'logs'"
            raise LogError(got, file=file, element=element, expected=expected)
        numbers = [str(k) for k, column in enumerate(schema.names, start=1) if column == name]
        if len(numbers) > 1:
            got = f"the same name for the columns {', '.join(numbers)}"
            raise LogError(got, file=file, element=element, expected="it once", do="rename one of them")
    missing = [x for x in columns if not stored_names(x, schema.names)]
    # Evenly spaced rows (setting `sample_rate`) need no column of times.
    if mapping.sample_rate and missing[:1] == columns[:1]:
        del missing[0]
    if missing:
        raise missing_columns(missing, schema.names, file, mapping, joints)
    _require_units(schema, columns, mapping, joints, file)
    labels = mapping.columns.trajectory if log.recording is None else None
    if labels not in schema.names:
        labels = None
    # A column of lists as names of recordings is rejected here: later it would raise an error that is hard to
    # understand.
    if labels and pa.types.is_nested(schema.field(labels).type):
        got = f"values of type {schema.field(labels).type}"
        raise LogError(got, file=file, element=f"column {labels}", expected="names")
    # The checks of units are omitted if the file declares its units.
    accepted: tuple[str, ...] = mapping.accept
    if UNITS_KEY in metadata:
        accepted += UNIT_CODES
    names = tuple(columns)
    return Layout(
        file, names, labels, tuple(joints), mapping, accepted, log.recording, log.remarks, log.header
    )


def list_element(name: str, columns: Collection[str]) -> tuple[str, int] | None:
    """Return ("position", 2) for a name like `position[2]`: a column of lists and an index; None for other names.

    columns: names of the table's columns.
    """
    match = re.fullmatch(r"(.+)\[(\d{1,3})\]", name)
    if match is None or name in columns or match[1] not in columns:
        return None
    return match[1], int(match[2])


def stored_names(name: str, columns: Collection[str]) -> list[str]:
    """Return the file's columns from which the column `name` of a mapping is computed; [] if one of them is absent.

    Examples: ["q"] for "q", ["position"] for "position[2]" (element of a list), ["sec", "nsec"] for "sec + nsec".
    columns: names of the file's columns.
    """
    element = list_element(name, columns)
    names = [name] if name in columns else [element[0]] if element else name.split(" + ")
    return names if set(names) <= set(columns) else []


def stored_columns(layout: Layout, columns: Collection[str]) -> list[str]:
    """Return the file's columns that must be read for a layout, each once.

    For columns of the layout such as `position[0]` and `position[1]` this is the file's column `position`.
    """
    labels = [layout.labels] if layout.labels else []
    return list(dict.fromkeys(chain(*(stored_names(x, columns) for x in layout.columns), labels)))


def missing_columns(
    missing: Sequence[str], columns: Collection[str], file: Path, mapping: LogMapping, joints: Sequence[str]
) -> LogError:
    """Return the error about missing columns of a log, with advice for the most likely cause.

    missing: missing columns, by the names that the mapping states. columns: names of all columns of the file.
    """
    of_quantity = {x: [mapping.column(x, joint) for joint in joints] for x in mapping.quantities}
    patterns = [mapping.pattern(x).replace("{joint}", "<joint>") for x in of_quantity]
    of_joints = dict(zip(joints, zip(*of_quantity.values(), strict=True), strict=True))
    unlogged = [joint for joint, names in of_joints.items() if set(names) <= set(missing)]
    # If all columns of a joint are missing, but not of all joints, the error states that this joint was not logged. The
    # mapping is probably right: a wrong column name affects one column of a joint, a wrong pattern affects all joints.
    if unlogged and len(unlogged) < len(joints):
        logged = ", ".join(joint for joint in joints if joint not in unlogged)
        do = (
            f"nothing was logged of {', '.join(unlogged)}: write 'moving_joints: [{logged}]' into the robot's YAML if "
            "the others do not move, or map its columns under 'logs'"
        )
    elif mapping.input == "torque" and _are_commands(columns, mapping, joints):
        do = SERVO_ADVICE
    elif list(missing) == [mapping.columns.t]:
        do = (
            "write its name as 'columns: {t: NAME}' under 'logs' in the robot's YAML, or 'sample_rate: HZ' if there is "
            "none and the rows are evenly spaced"
        )
    # If only velocities are missing, they can be computed from the positions: many loggers do not log velocities.
    elif set(missing) <= set(of_quantity.get("qd", ())):
        do = "write 'velocity: differentiated' under 'logs' in the robot's YAML where none were logged"
    else:
        used = {mapping.columns.t, mapping.columns.trajectory, *chain(*of_quantity.values())}
        do = _naming([x for x in columns if x not in used])
    element = f"missing column{'s' * (len(missing) > 1)} {shortened(missing, TUNING.listed)}"
    got = f"only the columns {shortened(list(columns), TUNING.listed)}"
    expected = ", ".join([mapping.columns.t, *patterns])
    return LogError(got, file=file, element=element, expected=expected, do=do)


def _are_commands(columns: Collection[str], mapping: LogMapping, joints: Sequence[str]) -> bool:
    """Return True if the columns of a log contain commanded positions of all joints and no torques."""
    commands = {mapping.column("u", joint) for joint in joints}
    torques = {mapping.column("tau", joint) for joint in joints}
    return torques.isdisjoint(columns) and all(x in columns or list_element(x, columns) for x in commands)


def _naming(unused: Collection[str]) -> str:
    """Return the advice, for an error message, about missing columns. unused: columns that were not expected."""
    # Columns of accelerations are not proposed as torques: files of the command `excite` contain accelerations, too.
    if all(x.lower().startswith(("qdd", "acc")) for x in unused):
        return "log them, torques for example as efforts of ROS, or as motor currents with a 'gain'"
    return (
        "rename the columns, or write their names under 'logs' in the robot's YAML: "
        "`spelgen logs LOGS --robot ROBOT.urdf --suggest FILE` drafts them"
    )


def joint_patterns(joints: Sequence[str], names: Collection[str]) -> dict[str, re.Pattern[str]]:
    """Return {joint: pattern that finds its name as a separate word}: the joint 1 is found in `q_1`, but not in `q_12`.

    Four forms of the joint names are searched in `names`, the column names. The first form that finds all joints is
    used. A new word may also begin with a capital letter, as in `kLeftElbow`.

    1. The full name.
    2. The name without the words that all joints share and no column has: `left_elbow` for left_elbow_joint. A shared
       word that columns have, such as `left`, may distinguish two arms.
    3. The name without the words that all joints share: `shoulder_pan` for shoulder_pan_joint.
    4. The name without these words and without numbers: `S` for joint_1_s.

    If no form finds all joints, the full name is used.
    """
    words = {joint: re.findall(r"[^\W_]+", joint) for joint in joints}
    shared = set.intersection(*map(set, words.values())) if len(joints) > 1 else set()
    absent = {x for x in shared if x.lower() not in "\n".join(names).lower()}
    capital, forms = r"(?-i:(?<=[a-z])(?=[A-Z]))", []
    for omitted, number in (({}, ""), (absent, ""), (shared, ""), (shared, r"\d+")):
        form = {
            x: [y for y in z if y not in omitted and not re.fullmatch(number, y)] for x, z in words.items()
        }
        # A shortened name must contain a letter. A bare number does not identify a joint, since the columns may be
        # numbered in another order than the joints.
        if not omitted or all(any(not x.isdigit() for x in of_joint) for of_joint in form.values()):
            texts = {x: r"[\W_]?".join(re.findall(r"\d+|[^\W\d_]+", "_".join(y))) for x, y in form.items()}
            word = rf"(?:(?<![^\W_])|{capital})%s(?:(?![^\W_])|{capital})"
            forms.append({x: re.compile(word % text, re.I) for x, text in texts.items()})
    return next((x for x in forms if all(any(map(y.search, names)) for y in x.values())), forms[0])


def stated_units(schema: pa.Schema) -> dict[str, str]:
    """Return {column: unit in lower case} from a line of units below the header of a file; {} if there is none."""
    stated: dict[str, str] = json.loads((schema.metadata or {}).get(STATED_KEY, "{}"))
    return stated


def _require_units(
    schema: pa.Schema, columns: Sequence[str], mapping: LogMapping, joints: Sequence[str], file: Path
) -> None:
    """Raise LogError if the file states units that are no SI units, and the mapping has no units for these columns."""
    stated = stated_units(schema)
    units: dict[str, str] = {}
    for name, (quantity, joint) in zip(columns, [("t", ""), *mapping.signals(joints)], strict=True):
        unit = mapped_unit(quantity, stated.get(name, "")) or ""
        if quantity == "t":
            is_mapped = mapping.time_scale != 1.0 or bool(mapping.sample_rate)
        else:
            has_gain = quantity == "tau" and mapping.joint(joint).gain
            is_mapped = bool(mapping.unit(quantity, joint) or has_gain)
        if unit not in ("", "s", "rad", "m", "rad/s", "m/s", "Nm", "N") and not is_mapped:
            units[quantity] = unit
    if units:
        line = ", ".join(f"{quantity}: {unit}" for quantity, unit in units.items())
        raise LogError(
            f"units in a line below the header: {line}", file=file, expected="SI units, or units in the mapping",
            do=f"write 'units: {{{line}}}' under 'logs' in the robot's YAML",
        )  # fmt: skip


@contextmanager
def reading(file: Path) -> Iterator[None]:
    """Context manager that converts exceptions of libraries about a damaged file to a LogError with the file's name."""
    try:
        yield
    except UNREADABLE as error:
        lines = str(error).splitlines() or [type(error).__name__]
        got, do = f"an unreadable {file.suffix[1:]} file ({lines[0].rstrip('.')})", None
        if file.is_file():
            with file.open("rb") as source:
                if source.read(len(LFS)) == LFS:
                    got, do = "a pointer of Git LFS in place of the file", "fetch the content: git lfs pull"
        raise LogError(got, file=file, do=do) from error
