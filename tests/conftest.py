"""Settings and fixtures of all tests: one thread for tiny matrices, the order of test files, folders, short fits."""

import gc
import os
import sys
from pathlib import Path

import pytest

# torch and numpy read the number of threads when they are first imported
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Byte code is cached even if the environment disables the cache: otherwise each of the processes that tests start would
# compile all imported packages, which takes as long as the imports (pip installs them without byte code).
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# Tests do not wait for the disk: a training writes 15 files, each wait takes 5 to 40 ms, and no test cuts the power.
os.fsync = lambda descriptor: None

# Garbage collection is off until all tests are imported (see `pytest_collection_finish`), which saves a fifth of the
# time of the imports.
gc.disable()

ROOT = Path(__file__).parents[1]

# The files that take longest. Workers of pytest-xdist take whole files in this order, so the longest start first.
LONGEST_FILES = (
    "test_log_geometry",
    "test_check_logs",
    "test_late_joints",
    "test_torque_fit",
    "test_docs",
    "test_advice",
    "test_servo",
    "test_export_onnx",
    "test_workflow",
    "test_live",
    "test_coupled_motors",
    "test_live_c",
    "test_training",
    "test_types",
    "test_resource_bounds",
    "test_contracts",
    "test_reference_arms",
    "test_comparison",
    "test_export_torch",
    "test_cli",
    "test_untrusted_files",
    "test_fit",
    "test_evaluation",
    "test_one_recording",
    "test_evidence",
    "test_jumps",
    "test_formulas",
    "test_meshes",
    "test_posterior",
    "test_ros2_estimator",
    "test_mapping_kept",
    "test_ros2_controller",
    "test_baselines",
    "test_formula_files",
    "test_run_folder",
    "test_arm",
    "test_as_built",
    "test_large_logs",
    "test_export_ros2",
    "test_export_c",
    "test_fuzz_files",
    "test_emit",
    "test_good_data",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the longest files first, so that none of them runs at the end while the other workers are idle."""
    order = {name: index for index, name in enumerate(LONGEST_FILES)}
    # the sort is stable: files that are not listed keep their order
    items.sort(key=lambda item: order.get(item.path.stem, len(order)))


def pytest_collection_finish() -> None:
    """Exempt imported modules from garbage collection: they live as long as the tests (saves 5 % of the time).

    Collections after 50,000 instead of 10,000 new objects save 2 % more: reference counts free most objects.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000)
    gc.enable()


@pytest.fixture(scope="session")
def robots() -> Path:
    """Return the folder of the project's own robots."""
    return ROOT / "robots"


@pytest.fixture(scope="session")
def shared() -> Path:
    """Return the folder of reference data next to the checkout; tests that read it skip if it is absent."""
    folder = ROOT.parent / "shared"
    if not folder.is_dir():
        pytest.skip("the reference data (../shared) is not on this machine")
    return folder


@pytest.fixture
def short_epochs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limit epochs to four steps, for tests of the files, commands and messages of a fit on windows."""
    from spelgen.fitting.tuning import FittingTuning

    monkeypatch.setattr("spelgen.fitting.momentum_objective.TUNING", FittingTuning(epoch_steps=4))


@pytest.fixture
def coarse_validation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limit rollouts of the validation to two integration steps per sample, for tests that do not assert its loss.

    Steep friction would otherwise be integrated with 1, 2, 4, ... 32 steps, which takes longer than a torque fit.
    """
    from spelgen.fitting.tuning import FittingTuning

    monkeypatch.setattr("spelgen.fitting.rollout.TUNING", FittingTuning(max_substeps=2))


@pytest.fixture
def short_torque_fits(monkeypatch: pytest.MonkeyPatch, coarse_validation: None) -> None:
    """Limit torque fits to a few outer iterations of two solver steps, for tests of files, commands and messages."""
    from spelgen.fitting.torque.tuning import TorqueTuning

    tuning = TorqueTuning(iterations=1, initial_steps=2, iteration_steps=2)
    for module in ("problem", "stages"):
        monkeypatch.setattr(f"spelgen.fitting.torque.{module}.TUNING", tuning)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add ``--update``, which rewrites the golden copies."""
    parser.addoption("--update", action="store_true", help="write golden files anew")
