"""Names of the columns of a log: the words that state quantities, joints and units, in several languages."""

import re
import unicodedata
from collections.abc import Mapping
from typing import NamedTuple

from spelgen.settings.log_mapping import UNIT_NAMES, is_unit, mapped_unit, plain_unit

WORDS = {
    quantity: frozenset(words.split())
    for quantity, words in (
        ("t", "t ts tm time times timestamp stamp clock tick datetime secs seconds millis zeit zeitstempel uhrzeit "
              "temps tiempo tempo tijd czas время 时间 時間 時刻 시간"),
        ("q", "q qpos pos position positions angle angles theta θ winkel posicion posición posizione posição positie "
              "hoek положение позиция угол 位置 角度 위치 각도"),
        ("qd", "qd dq qp qvel vel velocity velocities speed speeds omega ω geschwindigkeit geschw vitesse velocidad "
               "velocidade velocità snelheid prędkość скорость spd 速度 속도"),
        ("tau", "tau τ torque torques trq tq tor effort efforts eff force forces qfrc moment load current currents "
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
        "ipo set soll u leader consigne feedforward ff заданное заданный 目标 指令 设定 目標 목표",
        "actual act ai measured meas msr present feedback feed fb ist follower observation mesure 实际 反馈 実 現在 "
        "현재 실제",
        "error err std external ext tcp ee eef cartesian tool contact gravity friction disturbance dist interact dd "
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
    last = re.fullmatch(r"(.*?)[\s_.]*?((?:[^\W\d_]|°)+(?:/s|[\s_](?:per[\s_])?s)?)(?:(?!°)[\W\d_])*", bare)
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
