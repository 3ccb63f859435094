"""Wheel and sdist contain all files of the package, install elsewhere and build the same modules."""

import os
import pkgutil
import re
import shutil
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, metadata, requires
from pathlib import Path

import pytest

import spelgen
from spelgen.certificate.verify import verify
from spelgen.version import __version__

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """Return the folder into which pip installed a wheel of the checkout."""
    return pip_install(ROOT, tmp_path_factory.mktemp("wheel") / "site")


def pip_install(source: Path, site: Path) -> Path:
    """Install a checkout, a wheel or an sdist without its dependencies into a folder; return the folder."""
    pytest.importorskip("hatchling", reason="building the package needs hatchling")
    options = ["-qq", "--no-deps", "--no-build-isolation", "--no-compile", "--target", str(site)]
    subprocess.run([sys.executable, "-m", "pip", "install", *options, str(source)], check=True)
    return site


def files_of(site: Path) -> set[str]:
    """Return the files of an installation, without pip's records of the source."""
    files = [path for path in site.rglob("*") if path.is_file() and path.parent.name != "bin"]
    return {str(path.relative_to(site)) for path in files if path.name not in ("direct_url.json", "RECORD")}


def test_an_sdist_installs_as_the_checkout_does(installed, tmp_path):
    command = [sys.executable, "-m", "hatchling", "build", "--target", "sdist", "--directory", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    (sdist,) = tmp_path.glob("*.tar.gz")
    assert files_of(pip_install(sdist, tmp_path / "site")) == files_of(installed)


def test_wheel_holds_all_that_the_package_needs(installed):
    files = files_of(installed)
    source = [path for path in (ROOT / "spelgen").rglob("*") if path.is_file() and path.suffix != ".pyc"]
    assert {str(path.relative_to(ROOT)) for path in source} <= files
    templates = [path for path in (ROOT / "templates").rglob("*") if path.is_file()]
    assert {f"spelgen/{path.relative_to(ROOT)}" for path in templates} <= files
    assert {name.split("/")[0] for name in files if ".dist-info" not in name} == {"spelgen"}


def test_installed_command_builds_the_same_module(installed, robots, tmp_path):
    # in the working folder: otherwise the module would contain the path of the URDF, and modules would differ
    for path in robots.glob("rpr.*"):
        shutil.copy(path, tmp_path)
    command = [sys.executable, "-m", "spelgen", "build", "rpr.urdf", "-o", "module.py"]
    subprocess.run(command, cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(installed)}, check=True)
    assert (tmp_path / "module.py").read_text(encoding="utf-8") == spelgen.generate(robots / "rpr.urdf")


def test_every_name_of_the_api_is_there():
    assert sorted(spelgen._HOME) == spelgen.__all__ == dir(spelgen)
    rooms = {module.name for module in pkgutil.iter_modules(spelgen.__path__)}
    assert not rooms & set(spelgen.__all__), "a room of that name would take its place once it is imported"
    assert spelgen.__version__ == __version__
    for name in spelgen._HOME.keys() - {"__version__"}:
        assert getattr(spelgen, name).__module__ == spelgen._HOME[name]
    with pytest.raises(AttributeError, match="no attribute 'train'"):
        spelgen.train  # noqa: B018


def test_importing_it_imports_nothing_heavy():
    code = "import sys, spelgen; print({'numpy', 'torch', 'pydantic', 'lxml'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"


def test_objects_are_short_to_read(robots):
    arm = spelgen.load_arm(robots / "rpr.urdf")
    assert repr(arm) == "<Arm 'rpr': 3 joints of rpr.urdf>"
    told = "3 outputs, 2 constants, 11 base parameters"
    inspection = spelgen.inspect(arm)
    assert repr(inspection.structure) == f"<Structure of 3 joints (kinematics used): {told}>"
    told = "3 outputs and 2 constants, 11 base inertial parameters"
    assert repr(inspection) == f"<Inspection of 'rpr': {told}>"
    proof = verify(arm.robot, arm.chain, inspection.structure)
    for each in (inspection, proof, inspection.closed_forms((2, 2))):
        assert len(repr(each)) < 100
        assert each._repr_html_().count("<tr>") >= 2


# ---- dependencies


def pinned(name: str) -> dict[str, str]:
    """Return the pinned version of each package in a requirements file; each must have hashes, except torch."""
    text = (ROOT / name).read_text()
    blocks = re.findall(r"^([\w.-]+)==(\S+)((?: \\\n +--hash=sha256:[0-9a-f]{64})*)$", text, re.MULTILINE)
    if name != "requirements-torch.txt":
        assert all(hashes for _, _, hashes in blocks)
    return {canonical(package): version for package, version, _ in blocks}


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_every_package_is_pinned_by_hash():
    """Pinned requirements with hashes contain each dependency of the package.

    requirements.txt, which `make demo` installs, has the mandatory dependencies, Pinocchio and CasADi (for C code), but
    no other extra; requirements-tools.txt has all extras.
    """
    demo, tools = pinned("requirements.txt"), pinned("requirements-tools.txt")
    assert demo.items() <= tools.items()
    assert not {"ray", "mujoco", "onnx", "mkdocs", "mypy"} & set(demo)
    needed = [re.match(r"[\w.-]+", line)[0] for line in requires("spelgen") if "extra ==" not in line]
    assert {canonical(name) for name in needed} - {"torch"} <= set(demo)
    everything = {canonical(re.match(r"[\w.-]+", line)[0]) for line in requires("spelgen")}
    assert everything - {"torch"} <= set(tools)
    assert list(pinned("requirements-torch.txt")) == ["torch"]


def licence(package: str) -> str | None:
    """Return the licence that an installed package states; None if it is not installed."""
    try:
        about = metadata(package)
    except PackageNotFoundError:
        return None
    named = [
        line.rpartition(" :: ")[2]
        for line in about.get_all("Classifier", [])
        if line.startswith("License") and line.count(" :: ") > 1
    ]
    short = (about.get("License") or "").strip()
    first = about.get("License-Expression") or ", ".join(dict.fromkeys(named)) or short.split("\n")[0]
    return first[:80] or "not stated"


def test_licences_of_dependencies_are_listed(request):
    """docs/licences.md lists the licence of each dependency, none of which conflicts; `pytest --update` rewrites it."""
    packages = sorted({*pinned("requirements.txt"), *pinned("requirements-torch.txt")})
    page = ROOT / "docs" / "licences.md"
    if request.config.getoption("--update"):
        head = page.read_text().partition("| package")[0]
        rows = ["| package | licence |", "|---|---|", *(f"| {name} | {licence(name)} |" for name in packages)]
        page.write_text(head + "\n".join(rows) + "\n")
    listed = dict(re.findall(r"^\| ([\w.-]+) \| (.*) \|$", page.read_text(), re.MULTILINE))
    listed.pop("package")
    assert sorted(listed) == packages
    for package, text in listed.items():
        assert text == (licence(package) or text)
        # no licence conflicts with the Apache licence of this package, or forbids commercial use
        assert (
            not re.search(r"\b(A?GPL|AGPL|proprietary|non-?commercial)", text, re.IGNORECASE)
            or "LGPL" in text
        )
