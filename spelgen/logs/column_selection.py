"""Selection of the columns of a log: which columns are the positions, velocities, torques or commands of the joints."""

import re
from collections.abc import Collection, Mapping, Sequence
from itertools import chain, groupby
from pathlib import Path

from spelgen.errors import LogError, shortened
from spelgen.logs.column_names import (
    COMMANDED,
    COMPUTED,
    CURRENT,
    FEEDBACK,
    FILTERED,
    KNOWN,
    MEASURED,
    OTHERS,
    WORDS,
    ColumnName,
)
from spelgen.logs.tuning import TUNING


def columns_by_quantity(
    columns: Sequence[ColumnName], commands: bool, joints: int
) -> dict[str, list[ColumnName]]:
    """Return {quantity: columns} for the quantities "t", "q", "qd", "tau" or "u".

    commands: True for logs with commanded positions "u" instead of velocities and torques. joints: number of joints.
    Columns with a word for commands, such as "d" or "target", are omitted from logs of torques. If no names state
    positions, columns that only name a joint are positions.
    """
    by_quantity: dict[str, list[ColumnName]] = {x: [] for x in (("t", "q", "u") if commands else WORDS)}
    unstated, commanded = [], []
    for column in columns:
        quantity = column.quantity
        if commands and column.words & COMMANDED and quantity in ("q", None):
            quantity = "u"
        elif column.words & (COMMANDED | OTHERS):
            if column.quantity == "tau" and not column.words & (OTHERS | CURRENT):
                commanded.append(column)
            continue
        is_numbered = column.number >= 0 and column.words & (MEASURED | {"joint", "joints", "axis", "axes"})
        if quantity is None and (column.joint or is_numbered):
            unstated.append(column)
        if quantity in by_quantity:
            by_quantity[quantity].append(column)
    if len(by_quantity["q"]) < joints:
        by_quantity["q"] += unstated
    # If no other torques were logged, the commanded torques are used.
    if not commands and not by_quantity["tau"]:
        by_quantity["tau"] = commanded
    return by_quantity


def best_signal(columns: Sequence[ColumnName], joints: int, arm: Collection[str]) -> Sequence[ColumnName]:
    """Return the columns of the best signal of a quantity, for example of the measured and not the desired positions.

    A log may contain several signals of a quantity, each with a column for each joint. Names of a signal's columns
    differ only in the words of the joint. In this order, names with a word of the arm are preferred to names of other
    arms (`FR_0_actual` to `FL_0_actual` for the joints FR_hip, FR_knee), measurements to values that a model computed,
    torques to currents, signals of joints to signals of motors, names with a word such as "actual" to names with
    "feedback", which may be a term of a controller, and these to other names, unfiltered to filtered values, and names
    with few words to longer names. Example: `tau_J` is preferred to `tau_hat_filtered`.

    columns: all columns of the quantity, which are returned if no signal has a column for each of the `joints`.
    arm: words that all joint names share.
    """
    complete = complete_signals(columns, joints)
    best = min(reversed(complete), key=lambda x: _rank(x, arm), default=frozenset[str]())
    return complete.get(best, columns)


def complete_signals(columns: Sequence[ColumnName], joints: int) -> dict[frozenset[str], list[ColumnName]]:
    """Return {words of the column names: columns} of the signals that have at least as many columns as `joints`.

    Example: {frozenset({"joint", "pos"}): columns `joint_pos_1`, `joint_pos_2`, ...}. Words of joint names and numbers
    are not included, so all columns of a signal have the same words.
    """
    signals: dict[frozenset[str], list[ColumnName]] = {}
    for column in columns:
        signals.setdefault(frozenset(column.words), []).append(column)
    return {words: named for words, named in signals.items() if len(named) >= joints}


def require_one_arm(columns: Sequence[ColumnName], joints: int, arm: Collection[str], file: Path) -> None:
    """Raise LogError for positions of several arms, such as `left_q1` and `right_q1`, or q0 to q13 of 7 joints.

    columns: columns of changing positions in the log `file`. joints: number of joints. arm: words that all joint names
    share; columns with such a word belong to the arm.
    """
    signals = complete_signals(columns, joints)
    best = min(signals, key=lambda x: _rank(x, arm), default=frozenset[str]())
    # `best` is the set of words in the names of the preferred signal. `arms` contains `best` and the sets that differ
    # from it only in unknown words (not in `KNOWN`), such as "left" and "right": these may name arms. The names of two
    # arms may also differ only in numbers, such as q0 to q13. Numbers are no words, so these columns are one signal,
    # with more columns than joints.
    arms = [x for x in signals if _rank(x, arm) == _rank(best, arm) and not (x ^ best) & KNOWN]
    of_joint: dict[str, list[str]] = {}
    for column in chain.from_iterable(signals[x] for x in arms):
        label = column.joint or (str(column.number) if column.number >= 0 else column.name)
        of_joint.setdefault(label, []).append(column.name)
    rivals = max(of_joint.values(), key=len, default=[])
    if len(rivals) > 1 and len(of_joint) >= joints:
        raise LogError(
            f"positions of {len(rivals)} arms: {shortened(rivals, TUNING.listed)} are of one joint", file=file,
            expected="columns of one arm", do="remove the columns of the other arms, or write the mapping by hand",
        )  # fmt: skip
    unnamed = [x.name for x in signals.get(best, ()) if not x.joint]
    if len(unnamed) >= 2 * joints:
        got = f"{len(unnamed)} columns of positions that change: {shortened(abbreviated_names(unnamed), TUNING.listed)}"
        raise LogError(
            got, file=file, expected=f"{joints}, one for each joint",
            do="remove the columns of other joints, or write the mapping by hand",
        )  # fmt: skip


def _rank(words: frozenset[str], arm: Collection[str]) -> list[int]:
    """Return the sort key of a signal with these words; `best_signal` prefers the signal with the smallest key."""
    ranks = [not words.isdisjoint(x) for x in (COMPUTED, CURRENT, {"motor", "theta"})]
    measured = [words.isdisjoint(MEASURED - FEEDBACK), words.isdisjoint(FEEDBACK)]
    return [words.isdisjoint(arm), *ranks, *measured, not words.isdisjoint(FILTERED), len(words)]


def columns_by_joint(
    columns: Sequence[ColumnName], joints: Sequence[str], order: Mapping[str, int]
) -> dict[str, ColumnName]:
    """Return {joint: column}: the column whose name contains the name of the joint.

    If no column name contains a joint name, columns are assigned by the last number in their names. `order` may state
    the number of each joint, such as {"elbow": 2} for the column `q2` (see `_order_in_cells`). If `order` does not
    state the numbers of all joints, the columns with ascending numbers belong to the `joints` in the given order.
    """
    named = {column.joint: column for column in columns if column.joint}
    numbered = {x.number: x for x in columns if x.number >= 0}
    # pandas makes equal column names different: q, q, q becomes q, q.1, q.2. The first name has no number, which
    # `ColumnName` represents by -1, and is added here.
    if len(numbered) == len(joints) - 1:
        numbered = {x.number: x for x in columns}
    if named or len(numbered) < len(joints):
        return {joint: named[joint] for joint in joints if joint in named}
    if set(order) == set(joints):
        return {joint: numbered[order[joint]] for joint in joints if order[joint] in numbered}
    return dict(zip(joints, map(numbered.__getitem__, sorted(numbered)), strict=False))


def abbreviated_names(names: Sequence[str]) -> list[str]:
    """Return the names, with runs that differ only in a number, such as x1, x2, x3, abbreviated to `x1 ... x3`."""
    groups = [list(group) for _, group in groupby(names, lambda name: re.sub(r"\d+(?=\D*$)", "", name))]
    return [f"{x[0]} ... {x[-1]}" if len(x) > 2 else ", ".join(x) for x in groups]
