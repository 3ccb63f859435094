"""Tables of the numerical parameters of a model: inertial parameters, drives and friction."""

from collections.abc import Sequence

import numpy as np

from spelgen.arm.configured_arm import Arm
from spelgen.dynamics.body_regressor import about_center
from spelgen.dynamics.regressor_dynamics import urdf_parameters
from spelgen.emission.assemble import ArmModel
from spelgen.fitting.drive_quantities import TORQUE_UNITS, torque_drive_quantities
from spelgen.fitting.posterior import Posterior
from spelgen.fitting.run_record import Content
from spelgen.identification.intervals import Interval
from spelgen.labels import UNITS
from spelgen.listing import Listing
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics
from spelgen.structure.base_parameters import base_parameters


def parameter_tables(
    model: ArmModel | None, arm: Arm | None, identified: Content | None, posterior: Posterior | None
) -> list[Listing]:
    """Return the tables of the parameters of a run for a page: base parameters, bodies and joints.

    Args:
        model: The trained model; None if the run has no weights.
        arm: The arm with the parameters of the URDF; None if the URDF is unknown.
        identified: Result of linear least squares on the same logs, as JSON content.
        posterior: Posterior of the model, from which the 95 % intervals are computed; None: no intervals.
    """
    tables: list[Listing] = []
    if arm is not None and identified and "base_parameters" in identified:
        tables.append(base_table(arm, identified, posterior))
    elif posterior is not None:
        tables.append(posterior.listings[0])
    if isinstance(model, RigidBodyDynamics):
        tables.append(_body_table(model.inertial_parameters.detach().numpy(), arm, posterior))
        tables.append(_joint_table(model, arm, posterior))
    return tables


def base_table(arm: Arm, identified: Content, posterior: Posterior | None) -> Listing:
    """Return the table of base parameters: values of the URDF, of the model and of linear least squares.

    The values of the model and of least squares have 95 % intervals.

    Args:
        arm: The arm with the parameters of the URDF.
        identified: Result of linear least squares, as JSON content.
        posterior: Posterior of the model; None: no column of the model.
    """
    parameters = identified["base_parameters"]
    names, determined = ([parameter[key] for parameter in parameters] for key in ("name", "determined"))
    # The base parameters of bodies are first. The URDF has no values of the base parameters of friction and drives.
    urdf = [""] * len(names)
    for k, base in enumerate(base_parameters(arm.chain)):
        if base.value is not None:
            urdf[k] = f"{float(base.value):.4g}"
    columns = {"parameter": names, "URDF": urdf}
    note = "Intervals are of 95 % [kg, m, s]"
    if posterior is not None:
        # The column "model" has the values of the posterior, which has only the base parameters of bodies and
        # armatures. The column is empty for friction: its parameters cannot be compared, since the fit and least
        # squares have different friction models.
        estimates = {x.name: x for x in posterior.base_parameters}
        columns["model, 95 %"] = [estimates[name].text if name in estimates else "" for name in names]
        pairs = zip(names, determined, strict=True)
        determined = [estimates[name].determined if name in estimates else word for name, word in pairs]
        note += (
            "; a value of least squares may lie outside the interval of the model because of an effect that least "
            "squares has no column for"
        )
    columns["least squares, 95 %"] = list(map(_interval, parameters))
    columns["determined"] = determined
    # The formula of a base parameter is omitted if it equals the name: the parameter is then not a combination.
    columns["made of"] = [x["formula"] if x["formula"] != x["name"] else "" for x in parameters]
    return Listing.of_columns("Base parameters: identifiable combinations", columns, f"{note}.")


def _interval(parameter: Content) -> str:
    """Return the text of a base parameter of least squares: its value and, if known, half its 95 % interval.

    parameter: the base parameter in its JSON form.
    """
    if parameter["deviation"] is None:
        return f"{parameter['value']:.4g}"
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
        rows,
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
    columns = {"joint": list(model.joint_names)}
    note = "Viscous and Coulomb friction are fitted to the model's friction law."
    if posterior is not None:
        columns |= posterior.drive_columns
        note += " Intervals are of 95 %."
    else:
        quantities, constants = torque_drive_quantities(model)
        for quantity, values in zip(quantities, constants(model).tolist(), strict=True):
            columns[quantity.name] = _with_units(values, quantity.unit, model.joint_types)
    if arm is not None:
        damping = [joint.damping for joint in arm.chain.coordinates]
        friction = [joint.friction for joint in arm.chain.coordinates]
        columns["URDF: viscous"] = _with_units(damping, TORQUE_UNITS["viscous"], model.joint_types)
        columns["URDF: coulomb"] = _with_units(friction, TORQUE_UNITS["coulomb"], model.joint_types)
    return Listing.of_columns("Drives and friction", columns, note)


def _with_units(values: Sequence[float], unit: str, joint_types: Sequence[str]) -> list[str]:
    """Return the text of each of `values`, one per joint, with its unit, such as "0.12 Nm".

    unit: format string, such as "{0.torque}", whose argument is the entry of `UNITS` for the type of the joint.
    """
    pairs = zip(values, joint_types, strict=True)
    return [f"{value:.3g} {unit.format(UNITS[joint_type])}" for value, joint_type in pairs]
