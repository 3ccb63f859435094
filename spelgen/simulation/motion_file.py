"""CSV files of motions, as `spelgen excite` writes them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa

from spelgen.errors import LogError, in_one_line
from spelgen.excitation.trajectory import Motion
from spelgen.files import require_regular_file
from spelgen.logs.csv_files import csv_columns

MIN_SAMPLES = 20


def read_motion(file: Path, joints: Sequence[str]) -> Motion:
    """Return the motion in a CSV file with the columns `t`, and `q_`, `qd_`, `qdd_` per joint.

    Raises LogError for a file without these columns, for a value that is no finite number, for times that do not
    increase by equal steps from row to row, and for fewer than 20 rows.

    Args:
        file: The file.
        joints: Names of the n joints, in the order of the coordinates.
    """
    require_regular_file(file, LogError)
    wanted = ["t", *(f"{quantity}_{joint}" for quantity in ("q", "qd", "qdd") for joint in joints)]
    do = "`spelgen excite` writes such files for the same arm"
    try:
        table = csv_columns(file)
        missing = [name for name in wanted if name not in table.column_names]
        if missing:
            raise LogError(
                f"no column {', '.join(missing[:3])}",
                file=file,
                expected="t, q_, qd_ and qdd_ per joint",
                do=do,
            )
        values = np.stack([table[name].cast(pa.float64()).to_numpy() for name in wanted], axis=1)
    except (pa.ArrowException, UnicodeError) as error:
        raise LogError(
            f"unreadable ({in_one_line(error)})", file=file, expected="CSV of numbers", do=do
        ) from error
    if len(values) < MIN_SAMPLES or not np.isfinite(values).all():
        got = f"{len(values)} rows" if len(values) < MIN_SAMPLES else "a value that is no finite number"
        raise LogError(got, file=file, expected=f"{MIN_SAMPLES} rows of numbers or more", do=do)
    t = values[:, 0]
    steps = np.diff(t)
    if steps.min() <= 0 or np.ptp(steps) > 0.01 * steps.mean():
        row = int(np.argmax(np.abs(steps - np.median(steps))))
        raise LogError(
            f"a step of {steps[row]:g} s after {t[row]:g} s", file=file, line=row + 3, element="t",
            expected=f"equal steps (most are {np.median(steps):g} s)", do=do,
        )  # fmt: skip
    return Motion(t - t[0], *np.split(values[:, 1:], 3, axis=1))
