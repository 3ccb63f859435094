"""Tables of what a model has learned that is a number: inertial parameters, drives and friction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from spelgen.arm.configured_arm import ConfiguredArm
from spelgen.dynamics.linear_friction import FrictionModel
from spelgen.dynamics.parameters import parameters_of_kind
from spelgen.dynamics.regressor import urdf_parameters
from spelgen.dynamics.rigid_bodies import about_center
from spelgen.exporting.rigid_body_projection import nearest_friction, sampled_positions
from spelgen.identification.base_parameters import base_parameters
from spelgen.labels import UNITS, entry_name
from spelgen.listing import Listing
from spelgen.render.plots import Record
from spelgen.render.tuning import TUNING
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel

Rows = tuple[tuple[str, ...], ...]
DETERMINED = ("firm", "fair")


@dataclass(frozen=True)
class ParameterTable(Listing):
    """A table whose first column is a name. folded: rows that are folded away."""

    folded: Rows = ()
    folded_title: str = ""


def parameter_tables(
    model: ArmModel | None, arm: ConfiguredArm | None, identified: Record | None
) -> list[Listing]:
    """Return the tables of a run's parameters; `identified`: by least squares on the same logs."""
    tables: list[Listing] = []
    if arm is not None and identified and "base_parameters" in identified:
        tables.append(base_table(model, arm, identified))
    bodies = body_parameters(model)
    if bodies is not None:
        tables.append(_body_table(bodies, arm))
    if model is not None and hasattr(model, "armature"):
        tables.append(_joint_table(model, arm))
    if len(getattr(getattr(model, "mass", None), "raw_constants", ())):
        tables.append(_constant_table(model))
    return tables


def body_parameters(model: ArmModel | None) -> np.ndarray | None:
    """Return (bodies, 10) of a model of rigid bodies, as ``Body.inertia`` has them; None of another or of none."""
    if model is None or not isinstance(model, RigidBodyDynamics):
        return None
    values: np.ndarray = model.inertial_parameters.detach().numpy()
    return values


def base_table(model: ArmModel | None, arm: ConfiguredArm, identified: Record) -> ParameterTable:
    """Return what least squares found, beside the URDF and, where there is one, a model of rigid bodies."""
    effects = identified["method"]["effects"]
    friction = FrictionModel(stribeck="stribeck" in effects, polynomial="cubic" in effects)
    base = base_parameters(arm.arm, friction, arm.actuation.drives().speeds)
    parameters = identified["base_parameters"]
    names, determined, formulas = [], [], []
    for parameter in parameters:
        names.append(parameter["name"])
        determined.append(parameter["determined"])
        formulas.append("" if parameter["formula"] == parameter["name"] else parameter["formula"])
    nominal = base.combination[:, : 10 * len(arm.arm.bodies)] @ urdf_parameters(arm.arm)
    # a file says nothing of friction and drives, and some say nothing of bodies
    nominal[base.bodies :] = np.nan
    if not arm.arm.has_inertials:
        nominal[:] = np.nan
    columns = {"parameter": names, "URDF": list(map(_number, nominal))}
    note = "The intervals are those of least squares on the training logs [kg, m, s]"
    bodies = body_parameters(model)
    if model is not None and bodies is not None:
        # ten a body, then those of drives, of which a model has the armature in common with least squares
        common = np.concatenate([bodies.ravel(), model.armature.detach().numpy()])
        learned = base.combination[:, : len(common)] @ common
        for k in range(base.bodies, len(names)):
            if not names[k].startswith("armature"):
                learned[k] = np.nan
        columns["model"] = list(map(_number, learned))
        note += (
            "; a value of the model may lie outside its interval because of the prior, or of an effect that least "
            "squares has no column for"
        )
    columns["least squares, 95 %"] = list(map(_interval, parameters))
    columns["determined"], columns["made of"] = determined, formulas
    sure: list[tuple[str, ...]] = []
    unsure: list[tuple[str, ...]] = []
    for row in zip(*columns.values(), strict=True):
        if row[-2] in DETERMINED:
            sure.append(row)
        else:
            unsure.append(row)
    return ParameterTable(
        "Base parameters: identifiable combinations",
        tuple(columns),
        tuple(sure),
        f"{note}.",
        folded=tuple(unsure),
        folded_title=f"{len(unsure)} more, not significantly different from zero",
    )


def _number(value: float) -> str:
    """Return four digits; nothing for NaN."""
    return f"{value:.4g}".replace("nan", "")


def _interval(parameter: Record) -> str:
    """Return the value of a base parameter, with its interval where it has one."""
    value = f"{parameter['value']:.4g}"
    if parameter["deviation"] is not None:
        value += f" ± {TUNING.interval * parameter['deviation']:.2g}"
    return value


def _body_table(values: np.ndarray, arm: ConfiguredArm | None) -> Listing:
    names = [f"body {k + 1}" for k in range(len(values))]
    nominal = None
    if arm is not None:
        names = [body.name for body in arm.arm.bodies]
        if arm.arm.has_inertials:
            nominal = urdf_parameters(arm.arm).reshape(-1, 10)
    rows = []
    # the URDF below the model, body by body: differences are read down a column
    for k, name in enumerate(names):
        rows.append((name, "model", *_about_center(values[k])))
        if nominal is not None:
            rows.append(("", "URDF", *_about_center(nominal[k])))
    return Listing(
        "Masses, centres of mass and inertias",
        ("moves with", "by", "m [kg]", "centre of mass x, y, z [m]", "principal moments about it [kg m²]"),
        tuple(rows),
        "In the frame of the joint; z is its axis. Only the base parameters are identifiable: many such sets give the "
        "same motion. Every set shown is physically consistent.",
    )


def _about_center(body: np.ndarray) -> tuple[str, str, str]:
    """Return mass, centre of mass and principal moments about it, of ten parameters."""
    if body[0] <= 0:
        return f"{body[0]:.4g}", "", ""
    mass, center, tensor = about_center(body)
    return f"{mass:.4g}", _listed(center), _listed(np.linalg.eigvalsh(tensor))


def _listed(values: np.ndarray) -> str:
    return ", ".join(f"{value:.3g}" for value in values)


def _joint_table(model: ArmModel, arm: ConfiguredArm | None) -> Listing:
    """Return armature, friction and torque offset of each joint of a model that has an armature."""
    names, inertias, torques, slopes = [], [], [], []
    for number, kind in enumerate(model.joint_types, start=1):
        unit = UNITS[kind]
        names.append(f"joint {number}")
        inertias.append(unit.inertia)
        torques.append(unit.torque)
        slopes.append(f"{unit.torque} s/{unit.position}")
    columns = {"joint": names, "armature": _with_units(model.armature.tolist(), inertias)}
    note = ""
    if arm is not None:
        joints = arm.arm.coordinates
        columns["joint"] = list(arm.arm.joint_names)
        if isinstance(model, RigidBodyDynamics):
            viscous, forward, backward, _ = nearest_friction(arm.arm, model, sampled_positions(arm.arm))
            note = "Viscous and Coulomb friction are fitted to the model's friction law, as in exports."
            # the damping of a drive's control contains its joint's viscous friction
            if not parameters_of_kind(model, "damping"):
                columns["viscous"] = _with_units(viscous, slopes)
            columns["Coulomb, qd > 0"] = _with_units(forward, torques)
            columns["Coulomb, qd < 0"] = _with_units(backward, torques)
        columns["URDF: viscous"] = _with_units([joint.damping for joint in joints], slopes)
        columns["URDF: Coulomb"] = _with_units([joint.friction for joint in joints], torques)
    if isinstance(model, RigidBodyDynamics):
        columns["torque offset"] = _with_units(model.torque_offset.tolist(), torques)
    return Listing("Drives and friction", tuple(columns), tuple(zip(*columns.values(), strict=True)), note)


def _with_units(values: Sequence[float] | np.ndarray, units: Sequence[str]) -> list[str]:
    return [f"{value:.3g} {unit}" for value, unit in zip(values, units, strict=True)]


def _constant_table(model: Any) -> Listing:
    """Return the learned constants of M, in the units of the first entries that they are in."""
    mass = model.mass
    count = len(mass.raw_constants)
    # what each constant adds to M, (constants, n, n)
    functions = torch.zeros(len(getattr(mass, "function_mean", ())), count, dtype=torch.float64)
    units = torch.eye(count, dtype=torch.float64)
    rows = []
    for basis, value in zip(
        mass.entries(functions.unbind(), units.unbind()), mass.constants().tolist(), strict=True
    ):
        indices = basis.tril().nonzero().tolist()
        terms = [f"{basis[row, column].item():+.4g} {entry_name(row, column)}" for row, column in indices]
        first, second = (UNITS[model.joint_types[k]].inertia for k in indices[0])
        unit = first if first == second else "kg m"
        entries = " ".join(terms).replace("+1 ", "+ ").removeprefix("+ ")
        rows.append((entries, f"{value:.4g}", unit))
    note = "An entry of M is the sum of its constants and learned functions."
    return Listing("Constants of the mass matrix", ("entries", "learned", "unit"), tuple(rows), note)
