"""Copies and parts of a recording are recognized by their samples, and other recordings with the same name are not."""

from dataclasses import replace

import numpy as np
import pytest

from spelgen.logs.checks import check
from spelgen.logs.fingerprints import Fingerprints
from spelgen.logs.trajectory import Trajectory

JOINTS, TYPES = ["a", "b"], ["revolute", "revolute"]


def recording(seed: int, name: str = "recording", samples: int = 2000) -> Trajectory:
    """Return a recording of smooth random motion of two joints with noise in the torques."""
    rng = np.random.default_rng(seed)
    t = 0.01 * np.arange(samples)
    phases, speeds = rng.uniform(0, 6, (3, 2)), rng.uniform(0.3, 3, (3, 2))
    q = np.sin(speeds * t[:, None, None] + phases).sum(axis=1)
    qd = (speeds * np.cos(speeds * t[:, None, None] + phases)).sum(axis=1)
    return Trajectory(t=t, q=q, qd=qd, tau=qd + rng.normal(0, 0.1, q.shape), name=name)


def repeated(*logs: Trajectory) -> list[str]:
    """Return the messages about repeated samples."""
    return [f"{x.where}: {x.message}" for x in check(logs, JOINTS, TYPES) if x.code == "repeated-samples"]


@pytest.mark.parametrize(
    "change",
    [
        lambda x: x,
        lambda x: x[700:1600],
        lambda x: replace(x, t=x.t + 1e9),
        lambda x: replace(x, q=np.float64(np.float32(x.q)), tau=np.float64(np.float32(x.tau))),
    ],
    ids=["copy", "part", "another clock", "single precision"],
)
def test_a_copy_under_another_name_is_named(change):
    original = recording(0, "monday")
    (message,) = repeated(original, recording(1, "tuesday"), replace(change(original), name="again"))
    assert message == (
        "trajectory again: a quarter or more of its samples are also in trajectory monday: omit one of both"
    )


def test_different_recordings_share_no_samples():
    """Halves of a recording, other noise on the same motion, and rest at the same position are not reported."""
    one = recording(0)
    halves = one[:1000], replace(one[1000:], name="second half")
    assert not repeated(*halves)
    assert not repeated(one, replace(one, tau=one.tau + recording(1).tau, name="another day"))
    rest = np.zeros((2000, 2))
    resting = [
        Trajectory(
            t=0.01 * np.arange(4000),
            q=np.concatenate([rest, x.q - x.q[0]]),
            qd=np.concatenate([rest, x.qd]),
            tau=np.concatenate([rest, x.tau]),
            name=name,
        )
        for name, x in (("first", one), ("second", recording(1)))
    ]
    assert not repeated(*resting)


@pytest.mark.parametrize("samples", [1, 2, 3, 5])
def test_short_recordings_have_fingerprints(samples):
    known = Fingerprints()
    known.add("short", recording(0, samples=samples).fingerprint)
    assert known.original(recording(0, samples=samples).fingerprint) == ("short" if samples > 1 else None)
    assert known.original(recording(1, samples=samples).fingerprint) is None
