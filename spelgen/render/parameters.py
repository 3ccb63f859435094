"""What a model has learned that is a number: inertial parameters, drives and friction, beside the URDF's."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from spelgen.dynamics.protocol import has_rigid_bodies, has_servos
from spelgen.dynamics.regressor import urdf_parameters
from spelgen.fitting.servo_report import open_text, servo_listing
from spelgen.identification.base_parameters import base_parameters
from spelgen.identification.friction import FrictionModel
from spelgen.loaded_arm import LoadedArm
from spelgen.render.plots import FORCE, INERTIA_UNITS, UNITS

SURE_WORDS = ("firm", "fair")
SURE = 2.0  # standard deviations of an interval: 95 %
FAINT = 1e-4  # of dry friction: there is no such law
FRICTION_UNITS = {
    "viscous": "{force} s/{length}",
    "saturation_velocity": "{speed}",
    "stribeck_velocity": "{speed}",
    "coulomb_smoothing_velocity": "{speed}",
    "load_dependence": "",
}  # all others are a torque


@dataclass(frozen=True)
class ParameterTable:
    """title, heads and rows of text; the first column is a name. more: rows that are folded away. note: below it."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""
    more: tuple[tuple[str, ...], ...] = ()
    more_title: str = ""


def servo_table(record: Mapping[str, Any]) -> ParameterTable:
    """What a fit of position servos tells by joint; `record`: the run's, of servos."""
    listing = servo_listing(record, zones=True)
    return ParameterTable(listing.title, listing.head, listing.rows, f"{listing.note} {open_text(record)}.")


def parameter_tables(
    model: Any | None, arm: LoadedArm | None, identified: Mapping[str, Any] | None
) -> list[ParameterTable]:
    """All that is known of a run's parameters; `identified`: what least squares found of the same logs."""
    found = [] if model is None else [*_bodies(model, arm), *_joints(model, arm)]
    if arm is not None and identified and "base_parameters" in identified:
        found.insert(0, base_table(model, arm, identified))
    return found


def body_parameters(model: Any) -> np.ndarray | None:
    """(bodies, 10) of a closed-form model, as ``Body.inertia`` has them; None of another."""
    if not has_rigid_bodies(model):
        return None
    with torch.no_grad():
        values: np.ndarray = model.inertial_parameters.numpy()
    return values


def base_table(model: Any | None, arm: LoadedArm, identified: Mapping[str, Any]) -> ParameterTable:
    """What least squares found, beside the URDF and, where there is one, a closed-form model."""
    effects = identified["method"]["effects"]
    friction = FrictionModel(stribeck="stribeck" in effects, polynomial="cubic" in effects)
    base = base_parameters(arm.arm, friction, arm.actuation.drives().speeds)
    drives = len(base.parameters) - 10 * len(arm.arm.bodies)
    nominal = base.combination @ np.concatenate([urdf_parameters(arm.arm), np.zeros(drives)])
    learned = _learned(model, base.combination)
    rows: dict[bool, list[tuple[str, ...]]] = {True: [], False: []}
    for k, each in enumerate(identified["base_parameters"]):
        of_bodies, of_drives = k < base.bodies, each["name"].startswith("armature")
        away = each["deviation"]
        own = [] if learned is None else [f"{learned[k]:.4g}" if of_bodies or of_drives else ""]
        rows[each["determined"] in SURE_WORDS].append(
            (
                each["name"],
                f"{nominal[k]:.4g}" if of_bodies and arm.arm.has_inertials else "",
                *own,
                f"{each['value']:.4g}" + ("" if away is None else f" ± {SURE * away:.2g}"),
                each["determined"],
                "" if each["formula"] == each["name"] else each["formula"],
            )
        )
    model_head = () if learned is None else ("model",)
    told = "The intervals are those of least squares on the training logs [kg, m, s]"
    if learned is not None:
        told += (
            "; a value of the model outside its interval is either drawn there by the URDF, or tells of an effect "
            "that least squares has no column for"
        )
    return ParameterTable(
        "Base parameters: the only combinations that motion shows",
        ("parameter", "URDF", *model_head, "least squares, 95 %", "determined", "made of"),
        tuple(rows[True]),
        f"{told}.",
        tuple(rows[False]),
        f"{len(rows[False])} more that these logs hardly tell from zero",
    )


def _learned(model: Any, combination: np.ndarray) -> np.ndarray | None:
    """Base parameters of a closed-form model; those of friction are of other laws, and stay zero."""
    own = body_parameters(model)
    if own is None:
        return None
    parameters = np.zeros(combination.shape[1])
    parameters[: own.size] = own.ravel()
    if hasattr(model, "armature"):
        parameters[own.size : own.size + model.n] = model.armature.detach().numpy()
    found: np.ndarray = combination @ parameters
    return found


def _bodies(model: Any, arm: LoadedArm | None) -> Iterator[ParameterTable]:
    values = body_parameters(model)
    if values is None:
        return
    nominal = urdf_parameters(arm.arm).reshape(-1, 10) if arm and arm.arm.has_inertials else None
    names = [body.name for body in arm.arm.bodies] if arm else [f"body {k + 1}" for k in range(len(values))]
    rows = []
    for k, name in enumerate(names):
        rows.append((name, "model", *_about_centre(values[k])))
        if nominal is not None:
            rows.append(("", "URDF", *_about_centre(nominal[k])))
    yield ParameterTable(
        "Masses, centres of mass and inertias",
        ("moves with", "by", "m [kg]", "centre of mass x, y, z [m]", "principal moments about it [kg m²]"),
        tuple(rows),
        "In the frame of the joint, z its axis. One of many sets that move alike: what motion shows are base "
        "parameters; all sets shown belong to some real distribution of mass.",
    )


def _about_centre(ten: np.ndarray) -> tuple[str, str, str]:
    mass = ten[0]
    if mass <= 0:
        return f"{mass:.4g}", "", ""
    c = ten[1:4] / mass
    xx, xy, xz, yy, yz, zz = ten[4:]
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    moments = np.linalg.eigvalsh(tensor - mass * (c @ c * np.eye(3) - np.outer(c, c)))
    place, about = (", ".join(f"{x:.3g}" for x in values) for values in (c, moments))
    return f"{mass:.4g}", place, about


def _joints(model: Any, arm: LoadedArm | None) -> Iterator[ParameterTable]:
    """Armature and friction of each joint: whatever constants with one number a joint the model has."""
    types = tuple(model.joint_types)
    columns: dict[str, tuple[list[float], str]] = {}
    if hasattr(model, "armature"):
        columns["armature"] = ([float(x) for x in model.armature.tolist()], "armature")
    friction: Any = getattr(model, "friction", None)
    with torch.no_grad():
        prepared: Any = friction.prepare() if hasattr(friction, "prepare") else None
        named = prepared._asdict() if hasattr(prepared, "_asdict") else {}
        unused = {"offset", "smoothing", *_unused(model, friction)}
        for name, values in named.items():
            if torch.is_tensor(values) and values.shape == (len(types),) and name not in unused:
                columns[name] = (values.tolist(), name)
        if has_rigid_bodies(model):
            columns["torque offset"] = (model.torque_offset.tolist(), "offset")
    if not columns:
        return
    head = ["joint", *(name.replace("_", " ") for name in columns)]
    known = arm is not None
    if known:
        head += ["URDF: viscous, Coulomb"]
    rows = []
    for k, kind in enumerate(types):
        name = arm.arm.coordinates[k].name if arm else f"joint {k + 1}"
        absent = _absent(named, k)
        row = [
            name,
            *(
                "none" if what in absent else f"{values[k]:.3g} {_unit(what, kind)}".strip()
                for values, what in columns.values()
            ),
        ]
        if arm is not None:
            each = arm.arm.coordinates[k]
            row.append(f"{each.damping:.3g}, {each.friction:.3g}")
        rows.append(tuple(row))
    yield ParameterTable("Drives and friction", tuple(head), tuple(rows))


def _absent(friction: Mapping[str, Any], joint: int) -> tuple[str, ...]:
    """Constants of laws that a fit did not give to this joint."""
    slow, dry = (friction.get(name) for name in ("stribeck", "coulomb"))
    if slow is None or dry is None or slow[joint] > FAINT * dry[joint]:
        return ()
    return "stribeck", "stribeck_velocity"


def _unused(model: Any, friction: Any) -> tuple[str, ...]:
    """Constants of friction that this model's does not have: velocities of what remembers, and what kd stands for."""
    smoothed = getattr(friction, "raw_coulomb_smoothing_velocity", None) is not None
    found = () if smoothed else ("coulomb_smoothing_velocity",)
    return (*found, "viscous", "saturation", "saturation_velocity") if has_servos(model) else found


def _unit(what: str, kind: str) -> str:
    if what == "armature":
        return INERTIA_UNITS[f"{kind} {kind}"]
    length, speed = UNITS[kind]
    return FRICTION_UNITS.get(what, "{force}").format(force=FORCE[kind], length=length, speed=speed)
