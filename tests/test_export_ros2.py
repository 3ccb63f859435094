"""The exported ROS 2 package compiles against stubs of its interface and computes the torques of the model."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from exported_runs import arm_of, moved_model
from lxml import etree

from spelgen.exporting.export import export

STUBS = Path(__file__).parent / "ros2_stubs"
DRIVER = r"""
#include <inverse_dynamics_solver/inverse_dynamics_solver.hpp>
#include <cstdio>
#include <memory>
#include <stdexcept>
template <typename Base> Base * make_plugin();
template <> inverse_dynamics_solver::InverseDynamicsSolver * make_plugin();
int main()
{
  std::unique_ptr<inverse_dynamics_solver::InverseDynamicsSolver> solver(
    make_plugin<inverse_dynamics_solver::InverseDynamicsSolver>());
  solver->initialize(nullptr, "", "");
  Eigen::VectorXd q(2), qd(2), qdd(2), few(1);
  q[0] = 0.3; q[1] = -0.7; qd[0] = 0.5; qd[1] = -1.1; qdd[0] = 2.0; qdd[1] = 1.0;
  const auto M = solver->getInertiaMatrix(q);
  for (int i = 0; i < 2; ++i) { std::printf("%.17g %.17g\n", M(i, 0), M(i, 1)); }
  Eigen::VectorXd there = q;
  there[0] -= 2e-4; there[1] += 3e-3;
  for (const auto & row : {solver->getCoriolisVector(q, qd), solver->getGravityVector(q),
        solver->getFrictionVector(qd), solver->getTorques(q, qd, qdd), solver->getTorques(there, qd, qdd)}) {
    std::printf("%.17g %.17g\n", row[0], row[1]);
  }
  try { solver->getGravityVector(few); } catch (const std::invalid_argument & error) { std::puts(error.what()); }
}
"""


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    model = moved_model("two_link", "closed-form")
    folder = tmp_path_factory.mktemp("ros2") / "two_link_dynamics"
    export(model, "ros2", folder, arm=arm_of("two_link"))
    return model, folder


def test_it_is_a_colcon_package(package):
    _, folder = package
    manifest = etree.parse(folder / "package.xml")
    name = manifest.findtext("name")
    for plugin, base in [
        ("solver", "inverse_dynamics_solver::InverseDynamicsSolver"),
        ("controller", "controller_interface::ChainableControllerInterface"),
    ]:
        described = etree.parse(folder / f"{plugin}.xml").getroot()
        assert name == described.get("path") == "two_link_dynamics"
        assert described.find("class").get("type") == f"{name}::{plugin.capitalize()}"
        assert described.find("class").get("base_class_type") == base
        assert (folder / f"src/{plugin}.cpp").exists()
    used = set(re.findall(r"#include <(\w+)/", (folder / "src/controller.cpp").read_text()))
    assert used <= {dependency.text for dependency in manifest.findall("depend")}
    assert len((folder / "README.md").read_text().splitlines()) == 5


def run(*command: str | Path, cwd: Path | None = None) -> str:
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    assert not done.returncode, done.stdout + done.stderr
    return done.stdout


def c_object(folder: Path, tmp_path: Path) -> str:
    found = tmp_path / "two_link.o"
    run("gcc", "-std=c99", "-O1", "-c", folder / "src" / "two_link.c", "-o", found)
    return str(found)


def compiled_driver(folder: Path, tmp_path: Path, *linked: str) -> Path:
    """Compile a C++ program that calls all functions of the exported plugin; return its path."""
    (tmp_path / "driver.cpp").write_text(DRIVER)
    run("g++", "-std=c++17", "-Wall", "-Wextra", "-Werror", f"-I{STUBS}", f"-I{folder / 'src'}",
        tmp_path / "driver.cpp", *linked, "-o", tmp_path / "driver", "-lm")  # fmt: skip
    return tmp_path / "driver"


def driver_lines(driver: Path) -> list[str]:
    return run(driver).splitlines()


@pytest.mark.skipif(shutil.which("g++") is None, reason="no g++ on this machine")
def test_the_plugin_equals_the_model(package, tmp_path):
    model, folder = package
    (tmp_path / "driver.cpp").write_text(DRIVER)
    binary = compiled_driver(folder, tmp_path, str(folder / "src" / "solver.cpp"), c_object(folder, tmp_path))
    told = driver_lines(binary)
    assert told.pop() == "two_link has 2 joints, got 1 values"
    q, qd, qdd = (torch.tensor(x, dtype=torch.float64) for x in ([0.3, -0.7], [0.5, -1.1], [2.0, 1.0]))
    moved = torch.tensor([-2e-4, 3e-3], dtype=torch.float64)
    expected = [
        *model.mass_matrix(q),
        model.nonlinear_effects(q, qd) - model.gravity(q),
        model.gravity(q),
        # the first call has no history: it assumes the friction states of steady sliding at qd
        model.friction_torque(torch.zeros_like(q), qd, model.memory(qd)),
        model.inverse_dynamics(q, qd, qdd, model.memory(qd)),
        # The second call updates the friction states by the displacement since the first call, which is opposite to qd:
        # it reduces the bristle deflections of steady sliding at qd.
        model.inverse_dynamics(q + moved, qd, qdd, model.memory_after(model.memory(qd), moved)),
    ]
    found = np.array([[float(x) for x in line.split()] for line in told])
    np.testing.assert_allclose(found, torch.stack(expected).numpy(), rtol=1e-12, atol=1e-12)


@pytest.mark.skipif(shutil.which("g++") is None, reason="no g++ on this machine")
def test_it_builds_against_the_header_of_older_interfaces(package, tmp_path):
    """The plugin compiles with inverse_dynamics_solver 0.1.1, whose header has the suffix .h."""
    _, folder = package
    stubs = shutil.copytree(STUBS, tmp_path / "stubs")
    header = stubs / "inverse_dynamics_solver" / "inverse_dynamics_solver.hpp"
    header.rename(header.with_suffix(".h"))
    source = folder / "src" / "solver.cpp"
    run("g++", "-std=c++17", "-Wall", "-Wextra", "-Werror", "-fsyntax-only", f"-I{stubs}", source)


def stand_in_packages(folder: Path) -> list[str]:
    """Write CMake packages of the stubs of ROS 2; return the definitions with which CMake finds them.

    An installed ament_cmake is used instead of its stub.
    """
    interfaces = [
        "controller_interface",
        "hardware_interface",
        "inverse_dynamics_solver",
        "pluginlib",
        "rclcpp",
    ]
    interfaces += [
        "rclcpp_lifecycle",
        *(f"{name}_msgs" for name in ("geometry", "sensor", "std", "trajectory")),
    ]
    interfaces += ["rcl_interfaces", "Eigen3"]
    for name in interfaces:
        target = f"{name}::{'Eigen' if name == 'Eigen3' else name}"
        text = (
            f"if(NOT TARGET {target})\n  add_library({target} INTERFACE IMPORTED)\n"
            f"  target_include_directories({target} INTERFACE {STUBS})\nendif()\n"
            f"set({name}_TARGETS {target})\nset({name}_INCLUDE_DIRS {STUBS})\n"
        )
        if name == "pluginlib":
            text += (STUBS / "cmake" / "pluginlib.cmake").read_text()
        (folder / f"{name}Config.cmake").write_text(text)
    if Path("/usr/share/ament_cmake").is_dir():
        # the system's Python, which has the Python package of ament
        definitions = ["-DPython3_EXECUTABLE=/usr/bin/python3"]
    else:
        definitions = []
        shutil.copy(STUBS / "cmake" / "ament_cmakeConfig.cmake", folder)
    found = (f"-D{path.stem.removesuffix('Config')}_DIR={folder}" for path in sorted(folder.iterdir()))
    return [*definitions, *found]


@pytest.mark.skipif(
    not all(shutil.which(program) for program in ("cmake", "g++")),
    reason="no cmake or no g++ on this machine",
)
def test_colcon_builds_it(package, tmp_path):
    """colcon builds the package, and the installed library has both plugins; stubs replace ROS 2.

    If colcon is not installed, its CMake commands are run instead.
    """
    _, folder = package
    shutil.copytree(folder, tmp_path / "src" / folder.name)
    (tmp_path / "cmake").mkdir()
    definitions = stand_in_packages(tmp_path / "cmake")
    installed = tmp_path / "install" / folder.name
    # without its extensions colcon cannot select packages
    if shutil.which("colcon") and "--packages-select" in run("colcon", "build", "--help"):
        run("colcon", "build", "--packages-select", folder.name, "--cmake-args", *definitions, cwd=tmp_path)
    else:
        build = tmp_path / "build" / folder.name
        prefix = f"-DCMAKE_INSTALL_PREFIX={installed}"
        run("cmake", "-S", tmp_path / "src" / folder.name, "-B", build, prefix, *definitions)
        run("cmake", "--build", build, "--target", "install")
    for plugin, base in [("solver", "inverse_dynamics_solver"), ("controller", "controller_interface")]:
        assert (installed / "share" / base / "plugins" / f"{plugin}.xml").exists()
    assert (installed / "share" / folder.name / "config" / "controller.yaml").exists()
    assert (installed / "share" / folder.name / "package.xml").exists()
    library = installed / "lib" / f"lib{folder.name}.so"
    names = run("nm", "-D", "--defined-only", "-C", library)
    assert "make_plugin<inverse_dynamics_solver::InverseDynamicsSolver>()" in names
    assert "make_plugin<controller_interface::ChainableControllerInterface>()" in names
    by_colcon = compiled_driver(folder, tmp_path, str(library), f"-Wl,-rpath,{library.parent}")
    (tmp_path / "own").mkdir()
    own = compiled_driver(
        folder, tmp_path / "own", str(folder / "src" / "solver.cpp"), c_object(folder, tmp_path)
    )
    lines = (
        [[float(x) for x in line.split()] for line in driver_lines(each)[:-1]] for each in (by_colcon, own)
    )
    np.testing.assert_allclose(*lines, rtol=1e-13)


@pytest.mark.skipif("AMENT_PREFIX_PATH" not in os.environ, reason="no ROS 2 on this machine")
def test_colcon_builds_it_with_ros_2(package, tmp_path):
    _, folder = package
    shutil.copytree(folder, tmp_path / "src" / folder.name)
    run("colcon", "build", "--packages-select", folder.name, cwd=tmp_path)
    installed = tmp_path / "install" / folder.name
    assert "Controller" in run("nm", "-D", "-C", installed / "lib" / f"lib{folder.name}.so")
