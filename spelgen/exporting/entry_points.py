"""The quantities that a deployed model computes: one list for all formats."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from spelgen.errors import RunError, suggestion
from spelgen.exporting.description import TrainedModel


@dataclass(frozen=True)
class EntryPoint:
    """A function of an export.

    inputs: among q, qd, qdd, tau, u, dq (n numbers each) and z (the memory of friction). outputs: their units by name.
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
    """Return the functions of this model that are named, by default all but derivatives. Raises RunError for others."""
    available = list(ENTRY_POINTS)
    if model.servos is None:
        available.remove("servo_torque")
    if not names:
        # derivatives are two thirds of the code, and few need them
        names = [name for name in available if not name.endswith("_derivatives")]
    return {name: ENTRY_POINTS[name] for name in chosen(names, available)}


def chosen(names: Sequence[str], functions: Iterable[str]) -> list[str]:
    """Return which of the functions are named, all where none is. Raises RunError for other names."""
    options = list(functions)
    for name in names:
        if name not in options:
            expected = f"one of {', '.join(options)}"
            raise RunError(f"the function {name!r}", expected=expected, do=suggestion(name, options))
    if not names:
        return options
    # in their own order: the same choice gives the same files
    return [name for name in options if name in names]
