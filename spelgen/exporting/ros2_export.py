"""Export with ``--to ros2``: a colcon package of C files, a ros2_control controller and an inverse_dynamics_solver."""

import json
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from spelgen.exporting.c_export import c_files
from spelgen.exporting.describe import Trained
from spelgen.exporting.exported import Exported, with_readme
from spelgen.templates import render
from spelgen.urdf.values import UNLIMITED

_CALLED = (
    "inverse_dynamics", "mass_matrix", "bias", "gravity", "friction", "friction_step", "friction_memory",
)  # fmt: skip
"""The functions that the plugins call."""

_DEPENDENCIES = ("eigen", "inverse_dynamics_solver", "pluginlib", "rclcpp")
_CONTROLLER_DEPENDENCIES = (
    "controller_interface", "geometry_msgs", "hardware_interface", "rcl_interfaces", "rclcpp_lifecycle",
    "sensor_msgs", "std_msgs", "trajectory_msgs",
)  # fmt: skip
# Paths of files in the ROS 2 package; each file has a template of its name.
_PATHS = ("package.xml", "CMakeLists.txt", "solver.xml", "src/solver.cpp")
_CONTROLLER_PATHS = ("controller.xml", "config/controller.yaml", "src/controller.cpp", "src/control.hpp")


def export_ros2(trained: Trained) -> Exported:
    """Return the colcon package of ROS 2 with the model's C code.

    Raises RunError if results of C code and model differ.
    """
    model, missing = trained.described, _missing_part(trained)
    # The inverse_dynamics_solver plugin is part of each package; controller and estimator are optional.
    controller, estimator = missing is None or missing[0] != "controller", missing is None
    entries = (*_CALLED, "tip_pose") if estimator else _CALLED
    levels = trained.levels if estimator else None
    sources, checked = c_files(replace(trained, entries=entries, levels=levels))
    package = f"{model.name}_dynamics"
    context = {"package": package, "controller": controller, "name": model.name, "upper": model.name.upper()}
    context |= {"joints": ", ".join(model.joint_labels), "estimator": estimator}
    context["dependencies"] = sorted(_DEPENDENCIES + (_CONTROLLER_DEPENDENCIES if controller else ()))
    paths = [*_PATHS]
    if controller:
        paths += _CONTROLLER_PATHS
        context |= _controller_numbers(trained)
    files = {f"src/{name}": content for name, content in sources.items()}
    for path in paths:
        files[path] = render(f"ros2/{path.rpartition('/')[2]}.jinja", **context).encode()
    about = (
        "getTorques includes friction, and updates its state by the positions of successive calls; "
        "initialize resets it."
    )
    summary = [checked] if missing is None else [checked, f"no {missing[0]}: {missing[1]}"]
    use = _usage(package, model.name, controller=controller)
    return with_readme(trained, "ros2", files, use=use, about=about, summary=summary)


def _missing_part(trained: Trained) -> tuple[str, str] | None:
    """Return the part that the package cannot contain, "controller" or "estimator", and the reason.

    Return None if it contains all parts. The estimator is part of the controller: without the controller, it is absent,
    too.
    """
    model = trained.described
    if model.servos is not None or not model.actuated.all():
        return "controller", "it needs an effort interface of every joint"
    if trained.levels is None:
        return "estimator", "its noise levels are found from the training logs of a fit"
    # The estimator computes the payload in the frame of the last body, and the controller publishes it in the frame
    # of the tip link: both frames must belong to the same body.
    if model.tip.carrier != model.arm.load_body:
        return "estimator", "the tip link is not part of the last body"
    return None


def _usage(package: str, name: str, *, controller: bool) -> str:
    """Return the line of the README about the use of the ROS 2 package.

    package: name of the package. name: name of the model. controller: True if the package contains the controller.
    """
    use = (
        f"Put this folder into a workspace and run colcon build --packages-select {package}. "
        f"{package}/Solver is an inverse_dynamics_solver::InverseDynamicsSolver."
    )
    if controller:
        use += (
            f" {package}/Controller is a controller of ros2_control for effort interfaces: ros2 run controller_manager "
            f"spawner {name}_controller --param-file install/{package}/share/{package}/config/controller.yaml "
            f"compensates gravity; after ros2 param set /{name}_controller mode computed_torque it tracks the topic "
            "~/reference (trajectory_msgs/JointTrajectoryPoint) or a preceding joint_trajectory_controller."
        )
    return use


def _controller_numbers(trained: Trained) -> dict[str, object]:
    """Return {variable of the controller's templates: C++ or YAML text}: names, limits and the pose of the tip."""
    model, coordinates = trained.described, trained.arm.chain.coordinates
    names = trained.arm.chain.joint_names
    revolute = np.array([joint.joint_type == "revolute" for joint in coordinates])
    continuous = [str(joint.continuous).lower() for joint in coordinates]
    rotation = (f"{{{_listed(row)}}}" for row in model.tip.pose[:3, :3])
    return {
        "joint_names": ", ".join(map(cpp_string, names)),
        # Names are JSON strings, which are also valid YAML strings.
        "yaml_joints": ", ".join(map(json.dumps, names)),
        "yaml_references": ", ".join(json.dumps(f"{model.name}_controller/{x}") for x in names),
        # An effort limit that the URDF does not specify is 0; the user must set it.
        "efforts": _listed(joint.effort or 0.0 for joint in coordinates),
        "velocities": _listed(_velocity_limit(joint.velocity) for joint in coordinates),
        # [rad, m] Position error above which computed torque control stops.
        "position_errors": _listed(np.where(revolute, 0.2, 0.05)),
        # [rad, m] A position sensor counts as faulty if its value is constant while the integral of the measured
        # velocity exceeds this number.
        "frozen_travel": _listed(np.where(revolute, 1e-2, 1e-3)),
        "continuous": ", ".join(continuous),
        "tip_link": cpp_string(model.tip.link),
        "tip_rotation": ", ".join(rotation),
        "tip_position": _listed(model.tip.pose[:3, 3]),
        "filled": lambda value: _listed([value] * model.n),
    }


def _velocity_limit(velocity: float | None) -> float:
    """Return the velocity above which the controller damps a joint [rad/s, m/s]: 20 % above the URDF's limit.

    velocity: limit in the URDF. If it is None, the result is 1000, which no joint exceeds.
    """
    largest = UNLIMITED["velocity"]
    return largest if velocity is None else min(float(f"{1.2 * velocity:.4g}"), largest)


def _listed(numbers: Iterable[float] | np.ndarray) -> str:
    """Return numbers as text for C++ or YAML, separated by commas, without rounding."""
    return ", ".join(repr(float(number)) for number in numbers)


def cpp_string(text: str) -> str:
    """Return a C++ string literal of an untrusted text; all bytes except ASCII letters, digits and _-/ are escaped."""
    characters = []
    for character in text:
        plain = character.isascii() and (character.isalnum() or character in "_-/")
        # Escapes are octal, since an octal escape ends after three digits; a hexadecimal one would include a
        # next digit.
        characters.append(character if plain else "".join(f"\\{byte:03o}" for byte in character.encode()))
    return f'"{"".join(characters)}"'
