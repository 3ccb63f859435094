"""Reader of Parquet logs, of JSON and JSON lines, and of LeRobot 3 data sets, which consist of Parquet files."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.json
import pyarrow.parquet

from spelgen.errors import LogError, collect, shortened
from spelgen.files import read_json, require_regular_file
from spelgen.labels import counted
from spelgen.logs.bags import names_line
from spelgen.logs.npz import JOINT_NAMES
from spelgen.logs.tables import JOINTS_KEY, LogTable, reading
from spelgen.logs.tuning import TUNING
from spelgen.settings.log_mapping import LogMapping, MotorCalibration
from spelgen.settings.yaml_document import YamlDocument, validated

INFO = "meta/info.json"  # file in the folder of a LeRobot data set that describes its content
STATE, ACTION, TIMESTAMP, EPISODE = "observation.state", "action", "timestamp", "episode_index"
ENDING = ".pos"
# {quantity: its feature in a data set of an arm with torques, and endings of names in `observation.state`}
SIGNALS = {"qd": ("observation.velocity", (".vel",)), "tau": ("observation.effort", (".torque", ".effort"))}
# Largest magnitude of positions that LeRobot has normalised to -100..100, with a tolerance for rounding to single
# precision.
LARGEST_NORMALISED = 100.001
# Text of the remark that positions may be normalised and not in degrees. The check of servo logs removes this remark if
# the step size of the encoders determines the unit.
UNLESS_NORMALISED = "unless they are LeRobot's normalised values"


def read_parquet(file: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """Return the content of a Parquet file as a list of one table; columns are read only when they are needed."""
    schema = pa.parquet.read_schema(file)

    def read(names: list[str] | None) -> pa.Table:
        if names is not None:
            names = [x for x in schema.names if any(name == x or name.startswith(f"{x}.") for name in names)]
        # Pre-buffering is switched off, since it would keep the compressed file in memory in addition to the table.
        return _flat(pa.parquet.read_table(file, columns=names, pre_buffer=False))

    return [LogTable(_flat(schema.empty_table()).schema, reading(file)(read), mapping)]


def read_json_lines(file: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """Return the content of a file with one JSON object per line as a list of one table with one row per object.

    A last line that is cut off is omitted, with a remark.
    """
    text = file.read_bytes()
    lines, _, last = text.rstrip().rpartition(b"\n")
    # If the recorder was killed, the last line of the file is incomplete.
    is_cut = bool(lines) and not last.endswith(b"}")
    table = pa.json.read_json(pa.BufferReader(lines if is_cut else text))
    remarks = (f"the last line is cut off and was left out: {last[:30].decode(errors='replace')}",) * is_cut
    return [LogTable.of(_flat(table), mapping, remarks=remarks, header=0)]


def read_json_document(file: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """Return a list of one table, from a JSON file with a list of objects (rows), or with lists of values (columns).

    The longest list states the number of rows; shorter lists are omitted. Names of nested values are joined by points,
    such as `joints.elbow.position`; an object in a list is named by its value `name`, else by its index. A file with
    one object per line is read by `read_json_lines`.

    joints: names of the joints. mapping: mapping of the columns, which is added to the table.
    """
    try:
        document = json.loads(file.read_bytes())
    except json.JSONDecodeError as error:
        if error.msg == "Extra data":
            return read_json_lines(file, joints, mapping)
        raise
    except RecursionError:
        raise ValueError("nested too deeply") from None
    lists = dict(_lists(document, ""))
    rows = max(map(len, lists.values()), default=0)
    columns = {name: pa.array(values) for name, values in lists.items() if len(values) == rows}
    table = pa.table(columns)
    if len(columns) == 1 and pa.types.is_struct(table.schema.types[0]):
        table = pa.Table.from_struct_array(table[0].combine_chunks())
    names = [x for name, x in lists.items() if JOINT_NAMES.fullmatch(name.split(".")[-1]) and len(x) < rows]
    table = table.replace_schema_metadata({JOINTS_KEY: json.dumps([*names, []][0])})
    return [LogTable.of(_flat(table), mapping)]


def _lists(document: object, name: str) -> Iterator[tuple[str, list[object]]]:
    """Yield (name, items) of the lists in a JSON document, such as lists with an item per sample.

    Lists within a sample, such as the positions of all joints, are not yielded. If a list contains joints, each with
    lists of samples, the lists of the joints are yielded in place of this list.
    """
    items: Iterable[tuple[str, object]] = document.items() if isinstance(document, dict) else ()
    if isinstance(document, list):
        objects = [x for x in document if isinstance(x, dict)]
        # If an object contains a list longer than the list of objects, the objects are joints with lists of samples.
        # Otherwise they are samples, which contain numbers, or a list with a value per joint.
        if any(isinstance(x, list) and len(x) > len(document) for item in objects for x in item.values()):
            items = [(str(x.get("name", k)), x) for k, x in enumerate(objects)]
        else:
            yield name, document
    for key, item in items:
        yield from _lists(item, f"{name}.{key}" if name else key)


def _flat(table: pa.Table) -> pa.Table:
    """Return a table in which columns of structs are replaced by a column per field, such as `position.elbow`.

    Columns of lists of structs, such as the states of all motors, become a column of lists per field.
    """
    while True:
        while any(map(pa.types.is_struct, table.schema.types)):
            table = table.flatten()
        name = next((x.name for x in table.schema if _has_structs(x.type)), None)
        if name is None:
            return table
        column = table[name].combine_chunks()
        lists = column.cast(pa.list_(column.type.value_type))
        table = table.drop_columns([name])
        for field, values in zip(lists.type.value_type, lists.values.flatten(), strict=True):
            column = pa.ListArray.from_arrays(lists.offsets, values, mask=lists.is_null())
            table = table.append_column(f"{name}.{field.name}", column)


def _has_structs(kind: pa.DataType) -> bool:
    """Return True if an Arrow type is a list of structs."""
    is_list = pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)
    return bool(is_list and pa.types.is_struct(kind.value_type))


def read_dataset(folder: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """Return the tables of all Parquet files of a LeRobot data set; joints and motors are matched by their names.

    Raises LogError if the data set has no Parquet files, if a joint is not among the motors, and for normalised
    positions without a calibration.
    """
    info = read_json(folder / INFO, LogError)
    states, actions = _motor_names(folder, info, STATE), _motor_names(folder, info, ACTION)
    logged = {joint: mapping.log_name(joint) for joint in joints}
    for names in (states, actions):
        missing = [name for name in logged.values() if name not in names]
        if missing:
            absent = {joint: name for joint, name in logged.items() if name in missing}
            do = names_line(absent, names) if names else f"write them as 'names' of the features into {INFO}"
            raise LogError(
                f"the motors {', '.join(names) or 'without names'}", file=folder / INFO,
                expected=f"{', '.join(missing)} among them", do=do,
            )  # fmt: skip
    columns = {}
    for joint, name in logged.items():
        signals = {"q": f"{STATE}[{states.index(name)}]", "u": f"{ACTION}[{actions.index(name)}]"}
        for quantity, (feature, endings) in SIGNALS.items():
            if quantity in mapping.quantities and feature in info["features"]:
                motors = _motor_names(folder, info, feature)
                signals[quantity] = f"{feature}[{(motors if name in motors else states).index(name)}]"
            for named in {f"{name}{x}" for x in endings}.intersection(states):
                signals[quantity] = f"{STATE}[{states.index(named)}]"
        stated = mapping.joint(joint).columns.model_dump(exclude_none=True)
        columns[joint] = signals | {x: column for x, column in stated.items() if x in SIGNALS}
    mapping = mapping.with_joint_columns(columns)
    common = mapping.columns.model_copy(update={"t": TIMESTAMP, "trajectory": EPISODE})
    mapping = mapping.model_copy(update={"columns": common})
    files = sorted((folder / "data").rglob("*.parquet"))
    for file in files:
        require_regular_file(file, LogError, "files of episodes")
    if not files:
        expected = "data/chunk-000/file-000.parquet"
        raise LogError("a data set without Parquet files", file=folder, expected=expected)
    mapping, remarks = _with_scale(folder, files, joints, mapping)
    remarks += _missing_episodes(files, info)
    # Joint names without the suffix ".pos" are from LeRobot 2, which always writes degrees: the remarks that positions
    # may be normalised are removed.
    if ENDING not in str(info["features"][STATE]["names"]):
        remarks = tuple(x for x in remarks if UNLESS_NORMALISED not in x)
    fps = info.get("fps")
    if isinstance(fps, int | float) and not mapping.sample_rate:
        _require_times(files[0], fps)
        remarks += (
            f"times are frame numbers at {fps:g} frames per second and not measured: delays, damping and armatures are "
            "as right as this rate; 'sample_rate: HZ' under 'logs' states another one",
        )
    tables = []
    for file in files:
        with reading(file):
            tables += [table._replace(remarks=remarks) for table in read_parquet(file, joints, mapping)]
    return tables


def _column(file: Path, name: str) -> pa.Array | None:
    """Return one column of a file of a data set; None if the file lacks it."""
    with reading(file):
        if name not in pa.parquet.read_schema(file).names:
            return None
        return pa.parquet.read_table(file, columns=[name])[name].combine_chunks()


def _missing_episodes(files: Sequence[Path], info: Mapping[str, object]) -> tuple[str, ...]:
    """Return a remark on the episodes that are in none of the files of a LeRobot data set; () if all are."""
    total = info.get("total_episodes")
    columns = [column for file in files if (column := _column(file, EPISODE)) is not None]
    if not isinstance(total, int) or total > 10**6 or not columns:
        return ()
    numbers = set(chain(*(column.unique().to_pylist() for column in columns)))
    missing = [str(number) for number in range(total) if number not in numbers]
    text = f"{counted(len(missing), 'episode')} of {total} without a file"
    return (f"{text}: {shortened(missing, TUNING.listed)}",) if missing else ()


def _require_times(file: Path, fps: float) -> None:
    """Raise LogError if the times of a LeRobot data set contradict its number of frames per second."""
    times = _column(file, TIMESTAMP)
    steps = np.zeros(0) if times is None else np.diff(times.to_numpy(zero_copy_only=False).ravel())
    step = float(np.median(steps)) if steps.size else 0.0
    if step > 0 and fps > 0 and abs(step * fps - 1) > 0.05:
        raise LogError(
            f"{1 / step:.4g} times per second for {fps:g} frames per second in {INFO}", file=file,
            element=f"column {TIMESTAMP}", expected="one of both to be right",
            do=f"write 'sample_rate: {fps:g}', or the measured rate, under 'logs' in the robot's YAML",
        )  # fmt: skip


def _with_scale(
    folder: Path, files: Sequence[Path], joints: Sequence[str], mapping: LogMapping
) -> tuple[LogMapping, tuple[str, ...]]:
    """Return `mapping`, completed by the unit of the positions in a LeRobot data set, and remarks on the unit.

    By default LeRobot normalises the calibrated range of each motor to -100..100; degrees or radians are options. The
    data set does not state the unit. A largest value above 2 pi and at most about 100 may be normalised: the motors'
    calibration then converts the positions, unless `mapping` states a unit. Raises LogError if neither is known.
    """
    # `largest` is the largest magnitude of the positions of the arm's joints. Other elements of the state are not used:
    # they may belong to a gripper, or be velocities.
    largest, used = 0.0, {mapping.column("q", joint) for joint in joints}
    for states in (_column(file, STATE) for file in files):
        if states is None:
            return mapping, ()
        for index in range(pa.compute.max(pa.compute.list_value_length(states)).as_py() or 0):
            if f"{STATE}[{index}]" in used:
                long_enough = states.filter(pa.compute.greater(pa.compute.list_value_length(states), index))
                ends = pa.compute.min_max(pa.compute.list_element(long_enough, index)).as_py()
                largest = max(largest, *(abs(x) for x in ends.values() if x is not None), 0.0)
    if not 2 * np.pi < largest <= LARGEST_NORMALISED:
        return mapping, ()
    unstated = [joint for joint in joints if mapping.unit("q", joint) is None]
    if not unstated:
        unit = mapping.unit("q", joints[0])
        doubt = (
            f"positions within -100..100: right as {unit}, {UNLESS_NORMALISED}, which "
            "'units: {q: normalised}' and 'calibration' under 'logs' convert"
        )
        return mapping, (doubt,) if unit == "deg" else ()
    calibration = mapping.calibration or _calibration(folder, list(map(mapping.log_name, unstated)))
    if not all(mapping.log_name(joint) in calibration for joint in unstated):
        raise LogError(
            f"positions up to {largest:.4g} without a unit, within LeRobot's normalised range of -100..100",
            file=folder, expected="degrees, or the calibration of the motors",
            do="write 'units: {q: deg}' under 'logs' in the robot's YAML if they are degrees (use_degrees); "
            "else 'units: {q: normalised}' and 'calibration:' with the content of LeRobot's calibration file, or put "
            "that file into the folder of the data set as calibration.json",
        )  # fmt: skip
    units = mapping.units.model_copy(update={"q": "normalised"})
    mapping = mapping.model_copy(update={"units": units, "calibration": calibration})
    collect(mapping.misfits(joints))
    return mapping, ("normalised positions were converted by the ranges of the motors' calibration",)


def _calibration(folder: Path, motors: Sequence[str]) -> dict[str, MotorCalibration]:
    """Return {motor: calibration} from the file calibration.json of a LeRobot data set; {} if there is no such file.

    motors: names of the arm's motors; other motors in the file, for example of a gripper, are omitted.
    """
    for file in (folder / "calibration.json", folder / "meta" / "calibration.json"):
        if file.is_file():
            content = read_json(file, LogError)
            # A file that contains none of the motors has a wrong form: it is validated as a whole, which raises one
            # error.
            content = {x: content[x] for x in motors if x in content} or content
            return validated(LogMapping, {"calibration": content}, YamlDocument(file, None)).calibration
    return {}


def dataset_motors(folder: Path) -> list[str]:
    """Return the names of the motors of a LeRobot data set, in the order of the elements of `observation.state`."""
    return _motor_names(folder, read_json(folder / INFO, LogError), STATE)


def _motor_names(folder: Path, info: Any, feature: str) -> list[str]:
    """Return the motors of the elements of a feature, "observation.state" or "action", without LeRobot's suffix ".pos".

    info: content of the file that describes the data set.
    """
    try:
        names = info["features"][feature]["names"] or []
        # LeRobot writes the names of motors as a list or as a dict of lists, Unitree's recorders as a list of lists.
        lists = (
            names.values() if isinstance(names, dict) else [x if isinstance(x, list) else [x] for x in names]
        )
        return [str(name).removesuffix(ENDING) for name in chain(*lists)]
    except (KeyError, TypeError, AttributeError) as error:
        raise LogError(
            f"no names of {feature} ({type(error).__name__})", file=folder / INFO,
            expected='"features", with the motors\' "names", as LeRobot 3 writes them',
        ) from error  # fmt: skip
