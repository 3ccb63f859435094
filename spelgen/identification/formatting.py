"""An identification in words and numbers: 80 columns for the terminal, or JSON."""

from __future__ import annotations

import textwrap
from typing import Any

import numpy as np

from spelgen.identification.identify import Identification

WIDTH = 80
SCHEMA = 1
_FAR = (
    (30.0, "well posed"),
    (300.0, "acceptable"),
    (np.inf, "poor: some parameters trade against each other; excite the arm more"),
)
_UNIT = {"revolute": "Nm", "prismatic": "N "}
_SURE = ((0.05, "firm"), (0.2, "fair"), (1.0, "weak"), (np.inf, "may be zero"))


def to_dict(found: Identification) -> dict[str, Any]:
    """The JSON form, a public contract."""
    joints = [coordinate.name for coordinate in found.arm.coordinates]
    base = zip(found.base.columns, found.base.formulas(), found.values, found.deviations, strict=True)
    return {
        "schema": SCHEMA,
        "robot": found.arm.name,
        "joints": joints,
        "bodies": [body.name for body in found.arm.bodies],
        "trajectories": list(found.trajectories),
        "samples": found.samples,
        "method": {
            "weights": found.method.weights,
            "ridge": found.method.ridge,
            "prior": found.method.prior,
            "dry_velocity": found.method.friction.dry_velocity,
            "effects": list(found.method.friction.effects),
        },
        "condition": _number(found.condition),
        "unseen_directions": found.unseen,
        "base_parameters": [
            {
                "name": found.base.names[column],
                "formula": formula,
                "value": float(value),
                "deviation": _number(deviation),
                "determined": _certainty(value, deviation),
            }
            for column, formula, value, deviation in base
        ],
        "identifiability": found.base.told(),
        "residual": dict(zip(joints, map(float, found.residual), strict=True)),
        "nmse": dict(zip(joints, map(_number, found.nmse), strict=True)),
    }


def text(found: Identification) -> str:
    """For people."""
    bodies = 10 * len(found.arm.bodies)
    drives = int((found.base.columns >= bodies).sum())
    head = (
        f"{found.arm.name}: {len(found.base) - drives} base parameters of the bodies and {drives} of friction and "
        f"drives, from {found.samples} samples of {_counted(len(found.trajectories), 'trajectory', 'trajectories')}, "
        f"{_weighted(found)}."
    )
    certainties = [_certainty(*pair) for pair in zip(found.values, found.deviations, strict=True)]
    counts = ", ".join(f"{certainties.count(word)} {word}" for _, word in _SURE if word in certainties)
    lines = [*_wrapped(head), "", *_wrapped(_conditioned(found)), *_wrapped(f"Parameters: {counts}.")]
    lines += ["", "Torque not explained, root mean square and share of its variance (nMSE)", ""]
    lines += _residuals(found)
    lines += ["", "Base parameters [kg, m], with standard deviation; numbers after names: joint", ""]
    lines += _parameters(found, certainties)
    never = [name for name, how in found.base.told().items() if how == "never"]
    lines += [
        "",
        *_wrapped(f"No motion of this arm shows: {', '.join(never) or 'nothing; all have an effect'}."),
    ]
    return "\n".join(lines)


def _weighted(found: Identification) -> str:
    told = {
        "equal": "each Nm counting the same",
        "range": "each joint weighted by its torque's range",
        "noise": "each joint weighted by the noise left",
    }[found.method.weights]
    if found.method.ridge:
        told += f", ridge {found.method.ridge:g}"
    if found.method.prior is not None:
        told += f", with the URDF as prior ({found.method.prior:g})"
    return told


def _conditioned(found: Identification) -> str:
    if found.unseen:
        return (
            f"The logs say nothing in {_counted(found.unseen, 'direction', 'directions')} of the base parameters: "
            "those values are arbitrary; excite the arm more, or give --prior."
        )
    word = next(word for limit, word in _FAR if found.condition < limit)
    return f"Condition number {found.condition:.3g} (columns of length one): {word}."


def _residuals(found: Identification) -> list[str]:
    rows = zip(found.arm.coordinates, found.residual, found.nmse, strict=True)
    return [
        f"  {k:2}  {_short(joint.name, 40):<40}  {residual:10.4g} {_UNIT[joint.kind]}  {nmse:10.3g}"
        for k, (joint, residual, nmse) in enumerate(rows, start=1)
    ]


def _parameters(found: Identification, certainties: list[str]) -> list[str]:
    lines = []
    rows = zip(
        found.base.columns, found.base.formulas(), found.values, found.deviations, certainties, strict=True
    )
    for column, formula, value, deviation, certainty in rows:
        name = found.base.names[column]
        lines.append(f"  {name:<12} {value:12.5g} +- {deviation:<10.2g} {certainty}")
        if formula != name:
            lines += textwrap.wrap(f"= {formula}", WIDTH, initial_indent=" " * 6, subsequent_indent=" " * 8)
    return lines


def _certainty(value: float, deviation: float) -> str:
    if not np.isfinite(deviation):
        return _SURE[-1][1]
    return next(word for limit, word in _SURE if deviation <= limit * abs(value) or limit == np.inf)


def _number(value: float) -> float | None:
    """A float for JSON, which has no infinity."""
    return float(value) if np.isfinite(value) else None


def _counted(count: int, one: str, many: str) -> str:
    return f"{count} {one if count == 1 else many}"


def _wrapped(line: str) -> list[str]:
    return textwrap.wrap(line, WIDTH)


def _short(name: str, width: int) -> str:
    return name if len(name) <= width else name[: width - 3] + "..."
