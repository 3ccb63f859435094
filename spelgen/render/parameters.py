"""Tables of what a model has learned that is a number: inertial parameters, drives, friction and constants of M."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from spelgen.dynamics.protocol import has_rigid_bodies, has_servos
from spelgen.dynamics.regressor import urdf_parameters
from spelgen.fitting.run_folder import RunFolder, trained_model
from spelgen.identification.base_parameters import base_parameters
from spelgen.identification.friction import FrictionModel
from spelgen.loaded_arm import LoadedArm
from spelgen.render.plots import FORCE, UNITS, Record, inertia_unit
from spelgen.settings.tuning.render import TUNING

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

Rows = tuple[tuple[str, ...], ...]
DETERMINED = ("firm", "fair")
# of all others the unit is that of a torque
FRICTION_UNITS = {
    "viscous": "{force} s/{length}",
    "saturation_velocity": "{speed}",
    "stribeck_velocity": "{speed}",
    "coulomb_smoothing_velocity": "{speed}",
    "load_dependence": "",
}


@dataclass(frozen=True)
class ParameterTable:
    """title, heads and rows of text; the first column is a name. folded: rows that are folded away. note: below it."""

    title: str
    head: tuple[str, ...]
    rows: Rows
    note: str = ""
    folded: Rows = ()
    folded_title: str = ""


@dataclass(frozen=True)
class Constant:
    """A trained constant of M: where it enters, its value before training and after, in that entry's unit."""

    where: str
    start: float
    learned: float
    unit: str


def parameter_tables(
    model: EmittedModel | None, arm: LoadedArm | None, identified: Record | None
) -> list[ParameterTable]:
    """Return all that is known of a run's parameters; `identified`: by least squares on the same logs."""
    tables = []
    if arm is not None and identified and "base_parameters" in identified:
        tables.append(base_table(model, arm, identified))
    if model is None:
        return tables
    bodies = body_parameters(model)
    if bodies is not None:
        tables.append(_body_table(bodies, arm))
    columns = _joint_columns(model)
    if columns:
        tables.append(_joint_table(model, columns, arm))
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
    nominal = base.combination @ nominal
    learned = _learned(model, base.combination)
    sure: list[tuple[str, ...]] = []
    unsure: list[tuple[str, ...]] = []
    for k, parameter in enumerate(identified["base_parameters"]):
        of_bodies, value = k < base.bodies, f"{parameter['value']:.4g}"
        if parameter["deviation"] is not None:
            value += f" ± {TUNING.interval * parameter['deviation']:.2g}"
        row = [parameter["name"], f"{nominal[k]:.4g}" if of_bodies and arm.arm.has_inertials else ""]
        if learned is not None:
            row.append("")
            if of_bodies or parameter["name"].startswith("armature"):
                row[-1] = f"{learned[k]:.4g}"
        row += [value, parameter["determined"], parameter["formula"].replace(parameter["name"], "", 1)]
        if parameter["formula"] != parameter["name"]:
            row[-1] = parameter["formula"]
        if parameter["determined"] in DETERMINED:
            sure.append(tuple(row))
        else:
            unsure.append(tuple(row))
    head = ["parameter", "URDF", "least squares, 95 %", "determined", "made of"]
    note = "The intervals are those of least squares on the training logs [kg, m, s]"
    if learned is not None:
        head.insert(2, "model")
        note += (
            "; a value of the model may lie outside its interval because of the prior, or of an effect that least "
            "squares has no column for"
        )
    return ParameterTable(
        "Base parameters: identifiable combinations",
        tuple(head),
        tuple(sure),
        f"{note}.",
        tuple(unsure),
        f"{len(unsure)} more, not significantly different from zero",
    )


def _learned(model: EmittedModel | None, combination: np.ndarray) -> np.ndarray | None:
    """Return base parameters of a model of rigid bodies; those of friction follow other laws, and stay zero."""
    if model is None:
        return None
    bodies = body_parameters(model)
    if bodies is None:
        return None
    # ten a body, then those of drives, of which a model has the armature in common with least squares
    parameters = np.zeros(combination.shape[1])
    parameters[: bodies.size] = bodies.ravel()
    parameters[bodies.size : bodies.size + model.n] = model.armature.detach().numpy()
    learned: np.ndarray = combination @ parameters
    return learned


def _body_table(values: np.ndarray, arm: LoadedArm | None) -> ParameterTable:
    names = [f"body {k + 1}" for k in range(len(values))]
    nominal = None
    if arm is not None:
        names = [body.name for body in arm.arm.bodies]
        if arm.arm.has_inertials:
            nominal = urdf_parameters(arm.arm).reshape(-1, 10)
    rows = []
    # the URDF below the model, body by body: differences are read down a column
    for k, name in enumerate(names):
        rows.append((name, "model", *_about_centre(values[k])))
        if nominal is not None:
            rows.append(("", "URDF", *_about_centre(nominal[k])))
    return ParameterTable(
        "Masses, centres of mass and inertias",
        ("moves with", "by", "m [kg]", "centre of mass x, y, z [m]", "principal moments about it [kg m²]"),
        tuple(rows),
        "In the frame of the joint, z its axis. One of many sets that move alike: what motion shows are base "
        "parameters; all sets shown belong to some real distribution of mass.",
    )


def _about_centre(body: np.ndarray) -> tuple[str, str, str]:
    """Return mass, centre of mass and principal moments about it, of ten parameters."""
    mass = body[0]
    if mass <= 0:
        return f"{mass:.4g}", "", ""
    centre = body[1:4] / mass
    tensor = np.zeros((3, 3))
    tensor[np.triu_indices(3)] = body[4:]
    tensor = np.triu(tensor) + np.triu(tensor, 1).T
    # Steiner: the parameters are about the joint's frame
    about = tensor - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    return f"{mass:.4g}", _listed(centre), _listed(np.linalg.eigvalsh(about))


def _listed(values: np.ndarray) -> str:
    return ", ".join(f"{value:.3g}" for value in values)


def _joint_columns(model: EmittedModel) -> dict[str, list[float]]:
    """Return the constants with one number a joint: armature, friction laws and torque offset."""
    columns = {}
    if hasattr(model, "armature"):
        columns["armature"] = model.armature.tolist()
    if not has_rigid_bodies(model):
        return columns
    with torch.no_grad():
        constants = model.friction.prepare()._asdict()
    for name, values in constants.items():
        if torch.is_tensor(values) and values.shape == (model.n,) and name not in _unused(model):
            columns[name] = values.tolist()
    columns["torque offset"] = model.torque_offset.tolist()
    return columns


def _unused(model: EmittedModel) -> set[str]:
    """Return constants of friction that this model does not have, or that kd of its servos stands for."""
    unused = {"offset", "smoothing"}
    if getattr(model.friction, "raw_coulomb_smoothing_velocity", None) is None:
        unused.add("coulomb_smoothing_velocity")
    if has_servos(model):
        unused |= {"viscous", "saturation", "saturation_velocity"}
    return unused


def _joint_table(
    model: EmittedModel, columns: Mapping[str, Sequence[float]], arm: LoadedArm | None
) -> ParameterTable:
    head = ["joint", *(name.replace("_", " ") for name in columns)]
    if arm is not None:
        head.append("URDF: viscous, Coulomb")
    rows = []
    for k, kind in enumerate(model.joint_types):
        name = f"joint {k + 1}" if arm is None else arm.arm.coordinates[k].name
        row = [name]
        for column, values in columns.items():
            text = f"{values[k]:.3g} {_unit(column, kind)}".strip()
            row.append("none" if _is_absent(column, columns, k) else text)
        if arm is not None:
            joint = arm.arm.coordinates[k]
            row.append(f"{joint.damping:.3g}, {joint.friction:.3g}")
        rows.append(tuple(row))
    return ParameterTable("Drives and friction", tuple(head), tuple(rows))


def _is_absent(column: str, columns: Mapping[str, Sequence[float]], joint: int) -> bool:
    """Return whether the column belongs to a law that a fit did not give to this joint."""
    if column not in ("stribeck", "stribeck_velocity") or "coulomb" not in columns:
        return False
    return columns["stribeck"][joint] <= TUNING.no_law * columns["coulomb"][joint]


def _unit(column: str, kind: str) -> str:
    if column == "armature":
        return inertia_unit(kind, kind)
    length, speed = UNITS[kind]
    return FRICTION_UNITS.get(column, "{force}").format(force=FORCE[kind], length=length, speed=speed)


def constant_basis(mass: Any) -> torch.Tensor:
    """Return what each constant adds to M, (constants, n, n)."""
    count = len(mass.raw_constants)
    functions = torch.zeros(len(getattr(mass, "function_mean", ())), count, dtype=torch.float64)
    units = torch.eye(count, dtype=torch.float64)
    basis: torch.Tensor = mass.entries(functions.unbind(), units.unbind())
    return basis


def mass_constants(run: RunFolder) -> list[Constant]:
    """Return the constants of M that the best model of a run has learned; none where its preset has none.

    Raises ModuleError or RunError when the run cannot be read.
    """
    untrained, trained = run.load_module(), trained_model(run)
    mass: Any = getattr(trained, "mass", None)
    if not hasattr(mass, "constants"):
        return []
    constants = []
    bases = constant_basis(mass)
    start: Any = untrained.mass
    for basis, old, new in zip(bases, start.constants().tolist(), mass.constants().tolist(), strict=True):
        entries = [(row, column) for row, column in basis.tril().nonzero().tolist()]
        terms = []
        for row, column in entries:
            factor = f"{basis[row, column].item():+.4g}"
            sign, size = factor[0], factor[1:]
            entry = f"M{_index(row, column)}"
            if size != "1":
                entry = f"{size} {entry}"
            terms.append(f"{sign} {entry}")
        row, column = entries[0]
        unit = inertia_unit(trained.joint_types[row], trained.joint_types[column])
        where = " ".join(terms).removeprefix("+ ").replace("- ", "-", terms[0].startswith("-"))
        constants.append(Constant(where, old, new, unit))
    return constants


def _index(row: int, column: int) -> str:
    """Return `21` for row 1, column 0: the name of an entry of a matrix."""
    if row < 9:
        return f"{row + 1}{column + 1}"
    return f"({row + 1},{column + 1})"
