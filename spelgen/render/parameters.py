"""Tables of the numerical parameters of a model: inertial parameters, drives, friction, constants of M."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from spelgen.arm.configured_arm import Arm
from spelgen.dynamics.body_regressor import about_center
from spelgen.dynamics.friction import FrictionModel
from spelgen.dynamics.parameters import parameters_of_kind
from spelgen.dynamics.regressor_dynamics import urdf_parameters
from spelgen.emission.assemble import ArmModel
from spelgen.exporting.rigid_body_projection import nearest_friction, sampled_positions
from spelgen.fitting.posterior import Posterior
from spelgen.fitting.run_record import Content
from spelgen.identification.base_parameters import base_parameters
from spelgen.identification.intervals import PRECISE, Interval
from spelgen.labels import UNITS, entry_name
from spelgen.listing import Listing
from spelgen.runtime.derived_mass import ConstantMass, DerivedMass
from spelgen.runtime.network_dynamics import NetworkDynamics
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics

Rows = tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class ParameterTable(Listing):
    """A table with a name in the first column. folded: rows that are hidden on a page until the reader opens them."""

    folded: Rows = ()
    folded_title: str = ""


def parameter_tables(
    model: ArmModel | None, arm: Arm | None, identified: Content | None, posterior: Posterior | None
) -> list[Listing]:
    """Return the tables of the parameters of a run for a page: base parameters, bodies, joints, constants of M.

    Args:
        model: The trained model; None if the run has no weights.
        arm: The arm with the parameters of the URDF; None if the URDF is unknown.
        identified: Result of linear least squares on the same logs, as JSON content.
        posterior: Posterior of the model, from which the 95 % intervals are computed; None: no intervals.
    """
    tables: list[Listing] = []
    if arm is not None and identified and "base_parameters" in identified:
        tables.append(base_table(model, arm, identified, posterior))
    elif posterior is not None:
        tables.append(posterior.listings[0])
    if isinstance(model, RigidBodyDynamics):
        tables.append(_body_table(body_parameters(model), arm, posterior))
        tables.append(_joint_table(model, arm, posterior))
    elif isinstance(model, NetworkDynamics):
        mass = model.mass
        if isinstance(mass, DerivedMass | ConstantMass) and len(mass.raw_constants):
            tables.append(_constant_table(mass, model.joint_types))
    return tables


def body_parameters(model: RigidBodyDynamics) -> np.ndarray:
    """Return the inertial parameters of the bodies of a model, (bodies, 10) [kg, kg m, kg m^2].

    They are in the order of ``Body.inertia``.
    """
    return np.asarray(model.inertial_parameters.detach())


def base_table(
    model: ArmModel | None, arm: Arm, identified: Content, posterior: Posterior | None = None
) -> ParameterTable:
    """Return the table of base parameters.

    Its columns are the values of the URDF, of the model and of linear least squares. The values of least squares have
    95 % intervals; the values of the model have 95 % intervals if there is a posterior.

    Args:
        model: The trained model; None: no column of the model.
        arm: The arm with the parameters of the URDF.
        identified: Result of linear least squares, as JSON content.
        posterior: Posterior of the model; None: no intervals of the model.
    """
    effects = identified["method"]["effects"]
    friction = FrictionModel(stribeck="stribeck" in effects, polynomial="cubic" in effects)
    # The base parameters are derived again here, because they depend on the URDF and friction model only, not on logs.
    base = base_parameters(arm.chain, friction, arm.actuation.drives().speeds)
    parameters = identified["base_parameters"]
    names, determined = ([parameter[key] for parameter in parameters] for key in ("name", "determined"))
    nominal = base.combination[:, : 10 * len(arm.chain.bodies)] @ urdf_parameters(arm.chain)
    # A cell of the URDF's column is empty if the URDF has no value: it has none for friction and drives, and may have
    # no inertials.
    nominal[base.bodies :] = np.nan
    if not arm.chain.inertials_complete:
        nominal[:] = np.nan
    columns = {"parameter": names, "URDF": list(map(_number, nominal))}
    note = "Intervals are of 95 % [kg, m, s]"
    if posterior is not None:
        # The posterior has only base parameters of bodies and armatures, because the fit and least squares have
        # different friction models. In the rows of friction, the column of the model is empty.
        estimates = {x.name: x for x in posterior.base_parameters}
        columns["model, 95 %"] = [estimates[name].text if name in estimates else "" for name in names]
        pairs = zip(names, determined, strict=True)
        determined = [estimates[name].determined if name in estimates else word for name, word in pairs]
        note += (
            "; a value of least squares may lie outside the interval of the model because of an effect that least "
            "squares has no column for"
        )
    elif isinstance(model, RigidBodyDynamics):
        # The regressor of least squares starts with the columns of the inertial parameters and armatures, which are
        # also parameters of the trained model. The columns of friction have no counterpart in the model.
        common = np.concatenate([body_parameters(model).ravel(), model.armature.detach().numpy()])
        learned = base.combination[:, : len(common)] @ common
        for k in range(base.bodies, len(names)):
            if not names[k].startswith("armature"):
                learned[k] = np.nan
        columns["model"] = list(map(_number, learned))
    columns["least squares, 95 %"] = list(map(_interval, parameters))
    columns["determined"] = determined
    # The formula of a base parameter is omitted if it equals the name: the parameter is then not a combination.
    columns["made of"] = [x["formula"] if x["formula"] != x["name"] else "" for x in parameters]
    rows = list(zip(*columns.values(), strict=True))
    sure = tuple(row for row in rows if row[-2] in PRECISE)
    unsure = tuple(row for row in rows if row[-2] not in PRECISE)
    title = "Base parameters: identifiable combinations"
    folded_title = f"{len(unsure)} more, not significantly different from zero"
    return ParameterTable(title, tuple(columns), sure, f"{note}.", folded=unsure, folded_title=folded_title)


def _number(value: float) -> str:
    """Return the text of a number with four significant digits; "" for NaN."""
    return f"{value:.4g}".replace("nan", "")


def _interval(parameter: Content) -> str:
    """Return the text of a base parameter of least squares: its value and, if known, half its 95 % interval.

    parameter: the base parameter in its JSON form.
    """
    if parameter["deviation"] is None:
        return _number(parameter["value"])
    return Interval("", parameter["value"], parameter["deviation"]).text


def _body_table(values: np.ndarray, arm: Arm | None, posterior: Posterior | None) -> Listing:
    """Return the table of mass, centre of mass and principal moments of each body.

    values: inertial parameters of the model, (bodies, 10). arm: arm with the parameters of the URDF for comparison;
    None if unknown. posterior: intervals of the identifiable parameters; None if unknown.
    """
    alone = ""
    if posterior is not None:
        alone = ", ".join(f"{x.name} = {x.text} {x.unit}" for x in posterior.bodies)
        alone = f" Identifiable on their own, with 95 % intervals: {alone or 'none'}."
    names = [f"body {k + 1}" for k in range(len(values))]
    nominal = None
    if arm is not None:
        names = [body.name for body in arm.chain.bodies]
        if arm.chain.inertials_complete:
            nominal = urdf_parameters(arm.chain).reshape(-1, 10)
    rows = []
    # The values of the URDF are below the model's values of the same body, so that they are easy to compare.
    for k, name in enumerate(names):
        rows.append((name, "model", *_about_center(values[k])))
        if nominal is not None:
            rows.append(("", "URDF", *_about_center(nominal[k])))
    return Listing(
        "Masses, centres of mass and inertias",
        ("moves with", "by", "m [kg]", "centre of mass x, y, z [m]", "principal moments about it [kg m²]"),
        tuple(rows),
        "In the frame of the joint; z is its axis. Only the base parameters are identifiable: many such sets give the "
        f"same motion. Every set shown is physically consistent.{alone}",
    )


def _about_center(body: np.ndarray) -> tuple[str, str, str]:
    """Return mass, centre of mass and principal moments about the centre of a body, each as text for a table.

    body: inertial parameters (10,).
    """
    # A body in a URDF may have no mass. The cells of its centre of mass and principal moments are then empty.
    if body[0] <= 0:
        return f"{body[0]:.4g}", "", ""
    mass, center, tensor = about_center(body)
    return f"{mass:.4g}", _listed(center), _listed(np.linalg.eigvalsh(tensor))


def _listed(values: np.ndarray) -> str:
    return ", ".join(f"{value:.3g}" for value in values)


def _joint_table(model: ArmModel, arm: Arm | None, posterior: Posterior | None) -> Listing:
    """Return the table of armature, friction and torque offset of each joint of a model.

    The values have 95 % intervals if there is a posterior.
    """
    units = [UNITS[joint_type] for joint_type in model.joint_types]
    torques = [unit.torque for unit in units]
    dampings = [f"{unit.torque} s/{unit.position}" for unit in units]
    columns = {"joint": list(model.joint_names)}
    note = "Viscous and Coulomb friction are fitted to the model's friction law."
    if posterior is not None:
        # The posterior contains friction parameters and their intervals. Without a posterior, `nearest_friction` fits
        # viscous and Coulomb friction to the friction torque of the model.
        columns |= posterior.drive_columns
        note += " Intervals are of 95 %."
    else:
        columns["armature"] = _with_units(model.armature.tolist(), [unit.inertia for unit in units])
        columns["offset"] = _with_units(model.torque_offset.tolist(), torques)
    if arm is not None:
        joints = arm.chain.coordinates
        if posterior is None:
            friction = nearest_friction(arm.chain, model, sampled_positions(arm.chain))
            # A model of position servos has no column of viscous friction, because the damping gain of the servo
            # includes it.
            if not parameters_of_kind(model, "damping"):
                columns["viscous"] = _with_units(friction.viscous, dampings)
            columns["coulomb"] = _with_units(friction.coulomb, torques)
        columns["URDF: viscous"] = _with_units([joint.damping for joint in joints], dampings)
        columns["URDF: coulomb"] = _with_units([joint.friction for joint in joints], torques)
    return Listing("Drives and friction", tuple(columns), tuple(zip(*columns.values(), strict=True)), note)


def _with_units(values: Sequence[float] | np.ndarray, units: Sequence[str]) -> list[str]:
    return [f"{value:.3g} {unit}" for value, unit in zip(values, units, strict=True)]


def _constant_table(mass: DerivedMass | ConstantMass, joint_types: Sequence[str]) -> Listing:
    """Return the table of the learned constants of M, with the entries of M that contain each constant."""
    count = len(mass.raw_constants)
    # M is linear in the learned functions of q and in the learned constants. Therefore the derivative of M with respect
    # to a constant does not depend on q. `bases` contains the derivatives, (constants, n, n).
    functions = len(mass.function_mean) if isinstance(mass, DerivedMass) else 0
    # The derivative of M with respect to a constant is M for the value 1 of this constant, if all other constants and
    # all functions are 0.
    zeros = torch.zeros(functions, count, dtype=torch.float64)
    units = torch.eye(count, dtype=torch.float64)
    rows = []
    bases = mass.entries(*zeros.unbind(), *units.unbind())
    for basis, value in zip(bases, mass.constants().tolist(), strict=True):
        indices = basis.tril().nonzero().tolist()
        terms = [f"{basis[row, column].item():+.4g} {entry_name(row, column)}" for row, column in indices]
        # A constant in entries of different units is shown with the unit of the first entry.
        first, second = (UNITS[joint_types[k]].inertia for k in indices[0])
        unit = first if first == second else "kg m"
        entries = " ".join(terms).replace("+1 ", "+ ").removeprefix("+ ")
        rows.append((entries, f"{value:.4g}", unit))
    note = "An entry of M is the sum of its constants and learned functions."
    return Listing("Constants of the mass matrix", ("entries", "learned", "unit"), tuple(rows), note)
