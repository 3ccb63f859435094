"""The ROS 2 package: it compiles against stubs of the interface that it implements, and gives the model's torques."""

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
inverse_dynamics_solver::InverseDynamicsSolver * make_plugin();
int main()
{
  std::unique_ptr<inverse_dynamics_solver::InverseDynamicsSolver> solver(make_plugin());
  solver->initialize(nullptr, "", "");
  Eigen::VectorXd q(2), qd(2), qdd(2), few(1);
  q[0] = 0.3; q[1] = -0.7; qd[0] = 0.5; qd[1] = -1.1; qdd[0] = 2.0; qdd[1] = 1.0;
  const auto M = solver->getInertiaMatrix(q);
  for (int i = 0; i < 2; ++i) { std::printf("%.17g %.17g\n", M(i, 0), M(i, 1)); }
  for (const auto & row : {solver->getCoriolisVector(q, qd), solver->getGravityVector(q),
        solver->getFrictionVector(qd), solver->getTorques(q, qd, qdd)}) {
    std::printf("%.17g %.17g\n", row[0], row[1]);
  }
  try { solver->getGravityVector(few); } catch (const std::invalid_argument & error) { std::puts(error.what()); }
}
"""


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    model = moved_model("two_link", "closed-form")
    folder = tmp_path_factory.mktemp("ros2") / "two_link_solver"
    export(model, "ros2", folder, arm=arm_of("two_link"))
    return model, folder


def test_it_is_a_colcon_package(package):
    _, folder = package
    name = etree.parse(folder / "package.xml").findtext("name")
    plugin = etree.parse(folder / "plugin.xml").getroot()
    assert name == plugin.get("path") == "two_link_solver"
    assert plugin.find("class").get("type") == f"{name}::Solver"
    build = (folder / "CMakeLists.txt").read_text()
    assert f"project({name} LANGUAGES C CXX)" in build
    assert "pluginlib_export_plugin_description_file(inverse_dynamics_solver plugin.xml)" in build
    for source in ("src/solver.cpp", "src/two_link.c"):
        assert source in build
        assert (folder / source).exists()
    assert len((folder / "README.md").read_text().splitlines()) == 5


@pytest.mark.skipif(shutil.which("g++") is None, reason="no g++ on this machine")
def test_the_plugin_gives_what_the_model_gives(package, tmp_path):
    model, folder = package
    (tmp_path / "driver.cpp").write_text(DRIVER)
    commands = (
        ["gcc", "-std=c99", "-O1", "-c", str(folder / "src" / "two_link.c"), "-o", str(tmp_path / "two_link.o")],
        ["g++", "-std=c++17", "-Wall", "-Wextra", "-Werror", f"-I{STUBS}", f"-I{folder / 'src'}",
         str(tmp_path / "driver.cpp"), str(folder / "src" / "solver.cpp"), str(tmp_path / "two_link.o"),
         "-o", str(tmp_path / "driver"), "-lm"],
    )  # fmt: skip
    for command in commands:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert not done.returncode, done.stderr
    told = subprocess.run(
        [tmp_path / "driver"], capture_output=True, text=True, check=True
    ).stdout.splitlines()
    assert told.pop() == "two_link has 2 joints, got 1 values"
    q, qd, qdd = (torch.tensor(x, dtype=torch.float64) for x in ([0.3, -0.7], [0.5, -1.1], [2.0, 1.0]))
    expected = [
        *model.mass_matrix(q),
        model.nonlinear_effects(q, qd) - model.gravity(q),
        model.gravity(q),
        model.friction_torque(torch.zeros_like(q), qd),
        model.inverse_dynamics(q, qd, qdd),
    ]
    found = np.array([[float(x) for x in line.split()] for line in told])
    np.testing.assert_allclose(found, torch.stack(expected).numpy(), rtol=1e-12, atol=1e-12)
