"""Names of the columns of a log: the quantities, joints and units that they state, and the columns of each signal.

Names may have words of several languages.
"""

import re
import unicodedata
from collections.abc import Collection, Mapping, Sequence
from itertools import chain, groupby
from pathlib import Path
from typing import NamedTuple

from spelgen.errors import LogError, shortened
from spelgen.logs.tuning import TUNING
from spelgen.settings.log_mapping import UNIT_NAMES, is_unit, mapped_unit, plain_unit

WORDS = {
    quantity: frozenset(words.split())
    for quantity, words in (
        ("t", "t ts tm time times timestamp stamp clock tick datetime secs seconds millis zeit zeitstempel uhrzeit "
              "temps tiempo tempo tijd czas время 时间 時間 時刻 시간"),
        ("q", "q mp qpos pos position positions angle angles theta θ winkel posicion posición posizione posição "
              "positie hoek положение позиция угол 位置 角度 위치 각도"),
        ("qd", "qd dq qp qvel vel velocity velocities speed speeds omega ω geschwindigkeit geschw vitesse velocidad "
               "velocidade velocità snelheid prędkość скорость spd 速度 속도"),
        ("tau", "tau τ mt torque torques trq tq tor effort efforts eff force forces qfrc moment load current currents "
                "curr cur iq iqf drehmoment strom couple par coppia corrente corriente koppel момент ток 力矩 扭矩 "
                "电流 トルク 電流 토크 전류"),
    )
}  # fmt: skip
# Words in column names by which signals are classified: commanded values, measured values, other signals than the
# needed joint signals, and values that a model computed (used only if the log has no measured values).
COMMANDED, MEASURED, OTHERS, COMPUTED = (
    frozenset(words.split())
    for words in (
        "target targets desired des d command commands commanded cmd reference ref setpoint goal action demand planned "
        "ipo ip set soll u leader consigne feedforward ff заданное заданный 目标 指令 设定 目標 목표",
        "actual act ai measured meas msr present feedback feed fb ist follower observation mesure 实际 反馈 実 現在 "
        "현재 실제",
        "error err std external ext et tcp ee eef cartesian tool contact gravity friction disturbance dist interact dd "
        "ddot dot vol volt voltage temp temperature bias passive constraint residual payload 温度",
        "computed model predicted pred sim simulated g c f",
    )
)
# Words of `MEASURED` that may also name a term of a controller: in a log with `tau_measured`, `tau_feedback` is a part
# of the torque command.
FEEDBACK = {"feedback", "feed", "fb"}
# {letter: quantity} for names such as `i_actual` (motor current) and `m_actual` (moment).
LETTERS = {"i": "tau", "m": "tau"}
# Letters that count as units only in brackets, as in `time (s)`: without brackets they may be part of a name.
BARE = {"s", "n", "a", "m"}
# Names of derivatives of positions, such as `d_theta` and `q_dot`.
DERIVATIVE = r"(?<![^\W\d_])(?:d[ _]?(?:theta|pos|q)|(?:theta|pos|q)[ _]?dot)(?![^\W\d_])"
# All words that describe a signal. Any other word in a column name may be the name of an arm.
KNOWN = COMMANDED.union(MEASURED, OTHERS, COMPUTED, *WORDS.values())
FILTERED = {"filt", "filtered", "smooth", "smoothed"}
CURRENT = {"current", "currents", "curr", "cur", "iq", "iqf", "strom", "corrente", "corriente", "ток", "i"}
CURRENT |= {"电流", "電流", "전류"}
# Words that are not separated from others by blanks: words of Chinese, Japanese and Korean anywhere, long words at the
# end of a compound such as `Gelenkwinkel` or `motortorque`, and short words after the J of a joint, as in `JPOS1`.
GLUED = re.compile(
    "|".join(x for x in sorted(KNOWN.union(OTHERS), key=len, reverse=True) if x > "⺀")
    + rf"|(?<=[^\W\d_])(?:{'|'.join(x for x in WORDS['q'].union(WORDS['qd'], WORDS['tau']) if len(x) > 4)})(?![^\W\d_])"
    + r"|(?<=\bj)(?:pos|vel|trq|tau|cmd|cur)(?![^\W\d_])"
)


class ColumnName(NamedTuple):
    """Name of a column, and its parts.

    Attributes:
        name: the name.
        words: words of the name in lower case, without the words of the joint.
        unit: unit in the name, or in a line of units below the header; "" if there is none.
        joint: joint whose name the column's name contains; "" if there is none.
        quantity: "t", "q", "qd" or "tau"; None if neither words nor unit state it.
        number: last number in the name without its unit; -1 if there is none.
    """

    name: str
    words: set[str]
    unit: str = ""
    joint: str = ""
    quantity: str | None = None
    number: int = -1


def parse_column_name(
    name: str, labels: Mapping[str, re.Pattern[str]], unit: str, words: set[str]
) -> ColumnName:
    """Return the parts of a column's name; the unit is in brackets, or the last word.

    labels: {joint: pattern of its name}. unit: unit in a line of units below the header. words: additional words that
    describe the column, such as "time" for a column of dates.
    """
    # Units in brackets are removed before the search of joints: "deg/s" is not the joint s. Other brackets may contain
    # a number or a joint.
    # `fraction`: a unit such as 0.1%, at any place
    fraction = r"[\W_](\d*\.\d+ ?[^\W\d_]+|(?:\d*\.\d+ ?)?[%‰])(?![^\W_])"
    for bracket in re.finditer(rf"\s*[\[(]([^\])]+)[\])]|{fraction}", name):
        text = bracket[1] or bracket[2]
        is_other = re.search(r"[\d',]", text) or text in labels
        if is_unit(plain_unit(text)) or (bracket.end() == len(name) and not is_other):
            unit, name_without = plain_unit(text), name.replace(bracket[0], "", 1)
            return parse_column_name(name_without, labels, unit, words)._replace(name=name)
    matches = {joint: match for joint, label in labels.items() if (match := label.search(name))}
    joint = max(matches, key=lambda x: len(matches[x][0]), default="")
    bare = labels[joint].sub(" ", name) if joint else name
    numbers = re.findall(r"\d+", bare)
    # A column named `t`, or with another word for time, contains times, even if a joint has the same name.
    if joint and name.lower() in WORDS["t"]:
        joint, bare = "", name
    second = r"(?:(?:/|[\s_]per[\s_])s(?:ec(?:ond)?)?|[\s_]s)?"
    last = re.fullmatch(rf"(.*?)[\s_.]*?((?:[^\W\d_]|°)+{second})(?:(?!°)[\W\d_])*", bare)
    is_bare = last and (last[2].lower() in BARE or last[2] == name[:1])
    if not unit and last and not is_bare and is_unit(plain_unit(last[2])):
        bare, unit = last[1], plain_unit(last[2])
    separated = re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", bare).lower()
    separated = GLUED.sub(r" \g<0> ", unicodedata.normalize("NFKC", separated))
    texts = re.findall(r"[^\W\d_]+", re.sub(DERIVATIVE, "qd", separated))
    words = words | set(texts) | ({"theta"} if "theta" in separated else set())
    quantity = "t" if words & WORDS["t"] else None
    # The last word that states a quantity is the noun: `position` in `current_position` or `velocity_control/position`.
    for word in reversed(texts):
        if quantity is None and (quantity := next((x for x, y in WORDS.items() if word in y), None)):
            # Words for currents remain in `words` only if the noun is such a word, as in `motor_current`. Otherwise
            # they are adjectives: `current_torque` and `current_as_torque` are torques in Nm.
            words = words if word in CURRENT else words - CURRENT
    quantity = quantity or next((x for x in UNIT_NAMES if mapped_unit(x, unit)), None)
    if quantity is None and words & MEASURED:
        quantity = next((LETTERS[x] for x in texts if x in LETTERS), None)
    return ColumnName(name, words, unit, joint, quantity, int(numbers[-1]) if numbers else -1)


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
        is_numbered = column.number >= 0 and column.words & (
            MEASURED | {"joint", "joints", "j", "axis", "axes"}
        )
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
