"""NPZ archives -> tables: an array for each column, or matrices with a column for each joint."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa

from spelgen.errors import LogError
from spelgen.logs.tables import LogTable, element, made_layout, missing_columns, opened, wanted_quantities
from spelgen.settings.log_mapping import LogMapping

NAMES = "joints"  # the array of joint names, by the columns of the matrices
ENDING = ".npy"


class NpzArrays(Mapping[str, np.ndarray]):
    """The arrays of an NPZ archive, each read when it is first asked for, and never unpickled."""

    def __init__(self, file: Path, archive: zipfile.ZipFile) -> None:
        self._file, self._archive = file, archive
        self._members = {name.removesuffix(ENDING): name for name in archive.namelist()}
        self._arrays: dict[str, np.ndarray] = {}

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._arrays:
            member = self._members[name]
            self._arrays[name] = opened(self._file, lambda: self._read(member))
        return self._arrays[name]

    def __contains__(self, name: object) -> bool:
        return name in self._members

    def __iter__(self) -> Iterator[str]:
        return iter(self._members)

    def __len__(self) -> int:
        return len(self._members)

    def _read(self, member: str) -> np.ndarray:
        with self._archive.open(member) as data:
            return np.lib.format.read_array(data, allow_pickle=False)


def read_npz(file: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """One recording, or one for each text that `{trajectory}` stands for in the name of the times.

    Arrays that are not asked for are not looked at.
    """
    with opened(file, lambda: zipfile.ZipFile(file)) as archive:
        arrays = NpzArrays(file, archive)
        if "{trajectory}" not in mapping.columns.t:
            return [_npz_table(None, arrays, file, joints, mapping)]
        texts = [text for name in arrays if (text := _trajectory_text(mapping.columns.t, name))]
        if not texts:
            raise missing_columns([mapping.columns.t], list(arrays), file, mapping, joints)
        return [_npz_table(text, arrays, file, joints, mapping.of_trajectory(text)) for text in texts]


def npz_table(file: Path) -> pa.Table:
    """All arrays of numbers with a value, or a row, for each of the most samples that any has: matrices as lists."""
    with opened(file, lambda: zipfile.ZipFile(file)) as archive:
        arrays = {name: array for name, array in NpzArrays(file, archive).items() if array.ndim in (1, 2)}
    samples = max((len(array) for array in arrays.values()), default=0)
    kept = {name: _plain(array) for name, array in arrays.items() if len(array) == samples}
    return opened(file, lambda: pa.table({k: x if x.ndim == 1 else x.tolist() for k, x in kept.items()}))


def _trajectory_text(pattern: str, name: str) -> str | None:
    """What stands for `{trajectory}` in a name, everywhere the same; None where the name does not fit the pattern."""
    parts = pattern.split("{trajectory}")
    length, rest = divmod(len(name) - sum(map(len, parts)), len(parts) - 1)
    text = name[len(parts[0]) : len(parts[0]) + length]
    return text if length > 0 and not rest and pattern.replace("{trajectory}", text) == name else None


def _npz_table(
    text: str | None, arrays: NpzArrays, file: Path, joints: Sequence[str], mapping: LogMapping
) -> LogTable:
    """Each column an array of its own, or a column of a matrix: `q` (T, n) stands for all `q_<joint>`."""
    found = {mapping.columns.t: arrays[mapping.columns.t]} if mapping.columns.t in arrays else {}
    names = [mapping.columns.t]
    for quantity in wanted_quantities(mapping):
        pattern: str = getattr(mapping.columns, quantity)
        matrix = pattern.replace("{joint}", "").rstrip("_")
        for index, joint in enumerate(joints):
            name = mapping.column(quantity, joint)
            if matrix in arrays and arrays[matrix].ndim == 2:
                at = _place(arrays, index, mapping.log_name(joint), matrix, len(joints), file)
                name = f"{matrix}[:, {at}]"
                found[name] = arrays[matrix][:, at]
            elif name in arrays:
                found[name] = arrays[name]
            elif (place := element(name, list(arrays))) and arrays[place[0]].ndim == 2:
                columns = arrays[place[0]].T[place[1] : place[1] + 1]  # none where it is too narrow
                found.update(zip([name], columns, strict=False))
            names.append(name)
    if missing := [name for name in names if name not in found]:
        raise missing_columns(missing, list(arrays), file, mapping, joints)
    _require_samples(found, file)
    labels = mapping.columns.trajectory
    if text is None and labels in arrays:
        found[labels] = arrays[labels]
    table = opened(file, lambda: pa.table({name: _plain(array) for name, array in found.items()}))
    layout = made_layout(names, labels if labels in found else None, joints, mapping)
    return LogTable(text, table, layout)


def _plain(array: np.ndarray) -> np.ndarray:
    """The array with a type that Arrow knows: this machine's byte order, no more than double precision."""
    if array.dtype.kind == "f":
        return array.astype(float)
    return array.astype(array.dtype.newbyteorder("="))


def _place(arrays: NpzArrays, index: int, name: str, matrix: str, joints: int, file: Path) -> int:
    """The column of a joint in a matrix: as the array `joints` says, else in the order of the arm's joints."""
    columns = arrays[matrix].shape[1]
    known = [str(each) for each in arrays[NAMES].ravel()] if NAMES in arrays else None
    if known is None and columns != joints:
        raise LogError(
            f"{columns} columns", file=file, element=f"array {matrix}", expected=f"{joints}, one for each joint",
            do=f"name them by an array {NAMES!r}",
        )  # fmt: skip
    if known is not None and (name not in known or len(known) != columns):
        raise LogError(
            f"the joints {', '.join(known)}", file=file, element=f"array {NAMES}",
            expected=f"{name} among the names of the {columns} columns of {matrix}",
        )  # fmt: skip
    return index if known is None else known.index(name)


def _require_samples(found: dict[str, np.ndarray], file: Path) -> None:
    samples = next(iter(found.values())).shape
    for name, array in found.items():
        if array.ndim != 1 or array.shape != samples:
            raise LogError(
                f"an array of shape {array.shape}", file=file, element=f"array {name}",
                expected=f"a value for each of the {samples[0] if samples else 0} times",
            )  # fmt: skip
