"""Tables of what a model has learned that is a number: inertial parameters, drives, friction and constants of M."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from spelgen.dynamics.base_parameters import base_parameters
from spelgen.dynamics.linear_friction import FrictionModel
from spelgen.dynamics.parameters import parameters_of_kind
from spelgen.dynamics.protocol import has_rigid_bodies
from spelgen.dynamics.regressor import urdf_parameters
from spelgen.dynamics.rigid_bodies import about_center
from spelgen.exporting.rigid_body_projection import nearest_friction, sampled_positions
from spelgen.fitting.run_folder import RunFolder
from spelgen.labels import UNITS, entry_name
from spelgen.listing import Listing
from spelgen.loaded_arm import LoadedArm
from spelgen.render.plots import Record, inertia_unit
from spelgen.settings.tuning.render import TUNING

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

Rows = tuple[tuple[str, ...], ...]
DETERMINED = ("firm", "fair")


@dataclass(frozen=True)
class ParameterTable(Listing):
    """A table whose first column is a name. folded: rows that are folded away."""

    folded: Rows = ()
    folded_title: str = ""


def parameter_tables(
    run: RunFolder, model: EmittedModel | None, arm: LoadedArm | None, identified: Record | None
) -> list[Listing]:
    """Return the tables of a run's parameters; `identified`: by least squares on the same logs.

    Raises ModuleError or RunError when the run cannot be read.
    """
    tables: list[Listing] = []
    if arm is not None and identified and "base_parameters" in identified:
        tables.append(base_table(model, arm, identified))
    if model is None:
        return tables
    bodies = body_parameters(model)
    if bodies is not None:
        tables.append(_body_table(bodies, arm))
    joints = _joint_table(model, arm)
    if joints is not None:
        tables.append(joints)
    if len(getattr(getattr(model, "mass", None), "raw_constants", ())):
        tables.append(_constant_table(run.load_module(), model))
    return tables


def body_parameters(model: EmittedModel) -> np.ndarray | None:
    """Return (bodies, 10) of a model of rigid bodies, as ``Body.inertia`` has them; None of another."""
    if not has_rigid_bodies(model):
        return None
    values: np.ndarray = model.inertial_parameters.detach().numpy()
    return values


def base_table(model: EmittedModel | None, arm: LoadedArm, identified: Record) -> ParameterTable:
    """Return what least squares found, beside the URDF and, where there is one, a model of rigid bodies."""
    effects = identified["method"]["effects"]
    friction = FrictionModel(stribeck="stribeck" in effects, polynomial="cubic" in effects)
    base = base_parameters(arm.arm, friction, arm.actuation.drives().speeds)
    nominal = np.zeros(base.combination.shape[1])
    nominal[: 10 * len(arm.arm.bodies)] = urdf_parameters(arm.arm)
    learned = None
    bodies = None if model is None else body_parameters(model)
    if model is not None and bodies is not None:
        # ten a body, then those of drives, of which a model has the armature in common with least squares
        parameters = np.zeros_like(nominal)
        parameters[: bodies.size] = bodies.ravel()
        parameters[bodies.size : bodies.size + model.n] = model.armature.detach().numpy()
        learned = base.combination @ parameters
    nominal = base.combination @ nominal
    sure: list[tuple[str, ...]] = []
    unsure: list[tuple[str, ...]] = []
    head: list[str] = []
    for k, parameter in enumerate(identified["base_parameters"]):
        name, of_bodies = parameter["name"], k < base.bodies
        cells = {"parameter": name, "URDF": ""}
        if of_bodies and arm.arm.has_inertials:
            cells["URDF"] = f"{nominal[k]:.4g}"
        if learned is not None:
            cells["model"] = ""
            if of_bodies or name.startswith("armature"):
                cells["model"] = f"{learned[k]:.4g}"
        value = f"{parameter['value']:.4g}"
        if parameter["deviation"] is not None:
            value += f" ± {TUNING.interval * parameter['deviation']:.2g}"
        cells["least squares, 95 %"] = value
        cells["determined"] = parameter["determined"]
        cells["made of"] = ""
        if parameter["formula"] != name:
            cells["made of"] = parameter["formula"]
        head = list(cells)
        rows = sure if parameter["determined"] in DETERMINED else unsure
        rows.append(tuple(cells.values()))
    note = "The intervals are those of least squares on the training logs [kg, m, s]"
    if learned is not None:
        note += (
            "; a value of the model may lie outside its interval because of the prior, or of an effect that least "
            "squares has no column for"
        )
    return ParameterTable(
        "Base parameters: identifiable combinations",
        tuple(head),
        tuple(sure),
        f"{note}.",
        folded=tuple(unsure),
        folded_title=f"{len(unsure)} more, not significantly different from zero",
    )


def _body_table(values: np.ndarray, arm: LoadedArm | None) -> Listing:
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


def _joint_table(model: EmittedModel, arm: LoadedArm | None) -> Listing | None:
    """Return armature, friction and torque offset of each joint; None of a model without armature."""
    if not hasattr(model, "armature"):
        return None
    rigid = has_rigid_bodies(model)
    damped = parameters_of_kind(model, "damping")
    friction = None
    note = ""
    if arm is not None and rigid:
        friction = nearest_friction(arm.arm, model, sampled_positions(arm.arm))
        note = "Viscous and Coulomb friction are fitted to the model's friction law, as in exports."
    rows = []
    for k, kind in enumerate(model.joint_types):
        units = UNITS[kind]
        slope = f"{units.torque} s/{units.position}"
        cells = {"joint": f"joint {k + 1}", "armature": f"{model.armature[k]:.3g} {units.inertia}"}
        if friction is not None:
            viscous, forward, backward = friction.viscous[k], friction.forward[k], friction.backward[k]
            # the damping of a drive's control contains its joint's viscous friction
            if not damped:
                cells["viscous"] = f"{viscous:.3g} {slope}"
            cells["Coulomb, qd > 0"] = f"{forward:.3g} {units.torque}"
            cells["Coulomb, qd < 0"] = f"{backward:.3g} {units.torque}"
        if arm is not None:
            joint = arm.arm.coordinates[k]
            cells["joint"] = joint.name
            cells["URDF: viscous"] = f"{joint.damping:.3g} {slope}"
            cells["URDF: Coulomb"] = f"{joint.friction:.3g} {units.torque}"
        if rigid:
            cells["torque offset"] = f"{model.torque_offset[k]:.3g} {units.torque}"
        rows.append(cells)
    head = tuple(rows[0])
    return Listing("Drives and friction", head, tuple(tuple(cells.values()) for cells in rows), note)


def _constant_table(untrained: Any, trained: Any) -> Listing:
    """Return the constants of M that a model has learned, in the units of the first entries that they are in."""
    rows = []
    values = zip(untrained.mass.constants().tolist(), trained.mass.constants().tolist(), strict=True)
    # what each constant adds to M, (constants, n, n)
    count = len(trained.mass.raw_constants)
    functions = torch.zeros(len(getattr(trained.mass, "function_mean", ())), count, dtype=torch.float64)
    units = torch.eye(count, dtype=torch.float64)
    combinations = trained.mass.entries(functions.unbind(), units.unbind())
    for basis, (start, learned) in zip(combinations, values, strict=True):
        row, column = basis.tril().nonzero()[0].tolist()
        unit = inertia_unit(trained.joint_types[row], trained.joint_types[column])
        rows.append((_entry_sum(basis), f"{start:.4g}", f"{learned:.4g}", unit))
    return Listing(
        "Constants of the mass matrix",
        ("entries", "before training", "learned", "unit"),
        tuple(rows),
        "An entry of M is the sum of its constants and learned functions.",
    )


def _entry_sum(basis: torch.Tensor) -> str:
    """Return the entries of M's lower triangle with their factors: ``M21 - 0.5 M31``."""
    text = ""
    for row, column in basis.tril().nonzero().tolist():
        factor = f"{basis[row, column].item():+.4g}"
        text += f" {factor[0]} {factor[1:]} {entry_name(row, column)}"
    text = text.replace(" 1 ", " ").removeprefix(" + ")
    if text.startswith(" - "):
        return f"-{text[3:]}"
    return text
