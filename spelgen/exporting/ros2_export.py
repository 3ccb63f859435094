"""--to ros2: a colcon package with the C files and a plugin of the package inverse_dynamics_solver."""

from __future__ import annotations

from dataclasses import replace

from spelgen.exporting.c_export import c_files
from spelgen.exporting.describe import Trained
from spelgen.exporting.exported import Exported, with_readme
from spelgen.templates import render

_CALLED = (
    "inverse_dynamics", "mass_matrix", "bias", "gravity", "friction", "friction_step", "friction_memory",
)  # fmt: skip
"""The functions that the plugin calls."""

_PATHS = {
    "package.xml": "package.xml",
    "CMakeLists.txt": "CMakeLists.txt",
    "plugin.xml": "plugin.xml",
    "solver.cpp": "src/solver.cpp",
}


def export_ros2(trained: Trained) -> Exported:
    """Return the package. Raises RunError if its C differs from the model."""
    trained = replace(trained, entries=_CALLED)
    model = trained.described
    sources, checked = c_files(trained)
    package = f"{model.name}_solver"
    files = {f"src/{name}": content for name, content in sources.items()}
    for template, path in _PATHS.items():
        text = render(
            f"ros2/{template}.jinja",
            package=package,
            name=model.name,
            upper=model.name.upper(),
            joints=", ".join(model.identifiers),
        )
        files[path] = text.encode()
    use = (
        f"Put this folder into a workspace, colcon build --packages-select {package}; "
        f"the plugin {package}/Solver is an inverse_dynamics_solver::InverseDynamicsSolver."
    )
    about = (
        "getTorques includes friction, and updates its state by the positions of successive calls; "
        "initialize resets it."
    )
    return with_readme(trained, "ros2", files, use=use, about=about, summary=[checked])
