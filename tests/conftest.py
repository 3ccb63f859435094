"""What every test shares: one thread for tiny matrices, and where the robots and the reference data lie."""

import gc
import os
from pathlib import Path

import pytest

os.environ.setdefault("OMP_NUM_THREADS", "1")  # read by torch and numpy when they are first imported

ROOT = Path(__file__).parents[1]


def pytest_collection_finish() -> None:
    """What was imported lives as long as the tests do: the garbage collector need not go through it every time, which
    takes a twentieth of the time.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000)


@pytest.fixture(scope="session")
def robots() -> Path:
    """The folder of the project's own robots."""
    return ROOT / "robots"


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of reference data beside the checkout; tests that read it skip where it is absent."""
    folder = ROOT.parent / "shared"
    if not folder.is_dir():
        pytest.skip("the reference data (../shared) is not on this machine")
    return folder


@pytest.fixture
def short_epochs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Epochs of few windows take four steps: for tests of what stands around a fit."""
    from spelgen.fitting.tuning import WindowTuning

    monkeypatch.setattr("spelgen.fitting.window.momentum.TUNING", WindowTuning(epoch_steps=4))


@pytest.fixture
def short_torque_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fits to torques take two steps a round and few rounds: for tests of what stands around a fit."""
    from spelgen.fitting.torque.tuning import TorqueTuning

    tuning = TorqueTuning(rounds=1, first_steps=2, last_rounds=1, longer=1, steps=2)
    monkeypatch.setattr("spelgen.fitting.torque.problem.TUNING", tuning)


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--update`` writes the golden copies anew."""
    parser.addoption("--update", action="store_true", help="write golden files anew")
