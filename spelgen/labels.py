"""How joints and entries are named in pictures and sentences about a structure."""

from __future__ import annotations

from collections.abc import Sequence


def joint_ranges(joints: tuple[int, ...]) -> str:
    """The joints' numbers, from 1, with runs of three and more shortened: ``2-6`` or ``2,4``."""
    runs: list[list[int]] = []
    for joint in joints:
        if runs and joint == runs[-1][-1] + 1:
            runs[-1].append(joint)
        else:
            runs.append([joint])
    return ",".join(
        f"{run[0] + 1}-{run[-1] + 1}" if len(run) > 2 else ",".join(str(joint + 1) for joint in run)
        for run in runs
    )


def joints_in_ranges(joints: tuple[int, ...]) -> str:
    """``joint 2``, or ``joints 2-4,6``."""
    return f"joint{'s' * (len(joints) > 1)} {joint_ranges(joints)}"


def entry_name(row: int, column: int) -> str:
    """How an entry of M is called, from its 0-based place: M21, or M12,1 from ten joints on."""
    separator = "," if max(row, column) >= 9 else ""
    return f"M{row + 1}{separator}{column + 1}"


def joints_told(joints: Sequence[int]) -> str:
    """``joint 2``, or ``joints 2, 3 and 5``."""
    return f"joint{'s' * (len(joints) > 1)} {listed([str(joint + 1) for joint in sorted(joints)])}"


def axes_told(joints: Sequence[int]) -> str:
    """``the axis of joint 2``, or ``the axes of joints 2 and 3``."""
    return f"the {'axis' if len(joints) == 1 else 'axes'} of {joints_told(joints)}"


def listed(parts: Sequence[str]) -> str:
    """``a``, or ``a, b and c``."""
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"


def printable(text: str, kept: str = "") -> str:
    """Text from a file, with what could steer a terminal made visible, but for the characters ``kept``."""
    return "".join(c if c.isprintable() or c in kept else c.encode("unicode_escape").decode() for c in text)


def thousandths(joint_types: Sequence[str]) -> str:
    """The unit of small distances of these joints: ``mrad``, ``mm`` or, of both kinds, ``mrad, mm``."""
    slides = [kind == "prismatic" for kind in joint_types]
    return "mrad, mm" if len({*slides}) != 1 else "mm" if slides[0] else "mrad"
