"""Entry points: the functions of an export, one list for all formats."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from spelgen.errors import RunError, suggestion
from spelgen.exporting.description import TrainedModel


@dataclass(frozen=True)
class EntryPoint:
    """A function of an export.

    inputs: names among q, qd, qdd, tau, u, dq (n numbers each) and z (the friction state). outputs: units by name.
    """

    name: str
    about: str
    inputs: tuple[str, ...]
    outputs: dict[str, str]


_TORQUE = "Nm, N"

_ENTRY_POINTS = (
    EntryPoint(
        "inverse_dynamics",
        "the torques that give qdd, friction included",
        ("q", "qd", "qdd", "z"),
        {"tau": _TORQUE},
    ),
    EntryPoint(
        "forward_dynamics",
        "the accelerations under the torques tau",
        ("q", "qd", "tau", "z"),
        {"qdd": "rad/s^2, m/s^2"},
    ),
    EntryPoint("mass_matrix", "M, armature included", ("q",), {"mass": "kg m^2, kg m, kg"}),
    EntryPoint("bias", "Coriolis, centrifugal and gravity torques", ("q", "qd"), {"bias": _TORQUE}),
    EntryPoint("gravity", "the torques that hold the arm still, dV/dq", ("q",), {"gravity": _TORQUE}),
    EntryPoint("friction", "the torques of friction", ("q", "qd", "z"), {"friction": _TORQUE}),
    EntryPoint(
        "friction_step",
        "the friction state after a displacement dq of each joint",
        ("z", "dq"),
        {"z_next": "rad, m"},
    ),
    EntryPoint(
        "friction_memory",
        "the initial friction state of joints that have moved at constant qd",
        ("qd",),
        {"z_start": "rad, m"},
    ),
    EntryPoint("momentum", "M qd", ("q", "qd"), {"momentum": "Nm s, N s"}),
    EntryPoint("energy", "kinetic energy, then potential", ("q", "qd"), {"energy": "J"}),
    EntryPoint(
        "tip_pose", "the tip's homogeneous transform in the root link's frame", ("q",), {"pose": "1, m"}
    ),
    EntryPoint(
        "tip_jacobian",
        "the tip's linear, then angular velocity by qd, in the root link's axes",
        ("q",),
        {"jacobian": "m, 1"},
    ),
    EntryPoint(
        "inverse_dynamics_derivatives",
        "the derivatives of inverse_dynamics; its derivative by qdd is the mass matrix",
        ("q", "qd", "qdd", "z"),
        {"dtau_dq": "Nm/rad", "dtau_dqd": "Nm s/rad"},
    ),
    EntryPoint(
        "forward_dynamics_derivatives",
        "the derivatives of forward_dynamics",
        ("q", "qd", "tau", "z"),
        {"dqdd_dq": "1/s^2", "dqdd_dqd": "1/s", "dqdd_dtau": "1/(kg m^2)"},
    ),
    EntryPoint(
        "servo_torque",
        "the torques of position servos under a command u, which the caller delays",
        ("u", "q", "qd"),
        {"tau": _TORQUE},
    ),
)
ENTRY_POINTS = {entry.name: entry for entry in _ENTRY_POINTS}
"""All functions by name."""


def entry_points(model: TrainedModel, names: Sequence[str] = ()) -> dict[str, EntryPoint]:
    """Return entry points of a model by name; no names: all except derivatives. Raises RunError for unknown names."""
    available = list(ENTRY_POINTS)
    if model.servos is None:
        available.remove("servo_torque")
    if not names:
        # derivatives are two thirds of the code, and rarely needed
        names = [name for name in available if not name.endswith("_derivatives")]
    return {name: ENTRY_POINTS[name] for name in select_names(names, available)}


def select_names(names: Sequence[str], available: Iterable[str]) -> list[str]:
    """Return the names in the order of those available; no names: all. Raises RunError for unknown names."""
    options = list(available)
    for name in names:
        if name not in options:
            expected = f"one of {', '.join(options)}"
            raise RunError(f"the function {name!r}", expected=expected, do=suggestion(name, options))
    if not names:
        return options
    # in a fixed order: the same names give the same files
    return [name for name in options if name in names]
