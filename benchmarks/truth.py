"""Fit arms whose truth is known, and measure how far each method ends from it.

    python benchmarks/truth.py [--arms 100] [--first 0] [--jobs 2] [--out runs/truth.jsonl] [--panda]

Every case is drawn from its number alone: an arm (a real URDF or a random chain), the error of the given URDF,
friction of one of six kinds, armature, offsets, springs, a motion, a sample rate, noise and a delay of the
torques. Fitted to the same samples are the default preset, `hybrid`, least squares without and with friction's
memory, and figaroh's weighted least squares where it is installed. Results are appended to a file of JSON lines as
they come, so that a run goes on where it stopped. `--panda` adds a simulated Panda with 40 s of logs at 200 Hz and
3 % noise.

M error: mean over positions of |M - M*| / |M*| (Frobenius norm), and the largest relative error of a diagonal
entry; g error: root mean square relative to that of g*; error of the base parameters: likewise, each by the torque
that it makes along the test motion; friction error: likewise, without offsets; torque nMSE on another motion without
noise, raw and after a low-pass of 8 Hz.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import multiprocessing
import os
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lxml import etree
from scipy.signal import butter, sosfiltfilt

sys.path.insert(0, str(Path(__file__).parent))

from figaroh_identification import figaroh_dynamics

import spelgen
from spelgen.dynamics.bristles import bristle_reach
from spelgen.dynamics.protocol import memory_along
from spelgen.dynamics.regressor_dynamics import regressor
from spelgen.errors import SpelgenError
from spelgen.fitting.torque.fit import fit_torque
from spelgen.fitting.torque.objective import torque_delay
from spelgen.identification.base_parameters import base_parameters
from spelgen.logs.dynamics_samples import dynamics_samples

ARMS = Path(__file__).parents[2] / "shared" / "arms"  # a folder of URDFs beside the checkout, if there is one
FRICTIONS = ("none", "coulomb", "stribeck", "bristles", "load", "asymmetric")
FINE = 1000.0  # Hz: the grid on which truth is computed; logs take samples of it
POSITION_NOISE = 1e-5  # rad, m: of an encoder of 18 bits
SHARE = (0.03, 0.15)  # Coulomb friction by the deviation of the rigid torque, drawn log-uniformly
TINY = 1e-9


@dataclass(frozen=True)
class Case:
    """One arm and its logs, as drawn from its number."""

    number: int
    arm: str
    urdf_error: float  # standard deviation of inertials in the given URDF; infinite: placeholders
    friction: str
    armature: bool
    offsets: bool
    springs: bool
    motion: str
    seconds: float
    sample_rate: float
    noise: float
    delay: float  # s


def draw_case(number: int, arms: Sequence[str]) -> Case:
    """Draw the case of this number."""
    rng = np.random.default_rng(number)
    random_arm = rng.random() < 0.2 or not arms
    return Case(
        number=number,
        arm="random" if random_arm else str(rng.choice(arms)),
        urdf_error=float(rng.choice([0.0, 0.1, 0.25, 0.5, np.inf])),
        friction=str(rng.choice(FRICTIONS)),
        armature=bool(rng.random() < 0.7),
        offsets=bool(rng.random() < 0.3),
        springs=bool(rng.random() < 0.15),
        motion=str(rng.choice(["excitation", "pick-and-place"], p=[0.7, 0.3])),
        seconds=float(rng.choice([3.0, 10.0, 20.0, 40.0, 60.0])),
        sample_rate=float(rng.choice([50.0, 100.0, 200.0, 500.0, 1000.0])),
        noise=float(rng.choice([0.005, 0.01, 0.03, 0.1])),
        delay=float(rng.choice([0.0, 0.0, 0.002, 0.005])),
    )


class Truth:
    """The arm as it is: rigid bodies of its URDF, and what this benchmark adds to them."""

    def __init__(self, case: Case, urdf: Path, rng: np.random.Generator) -> None:
        self.case = case
        self.bodies = spelgen.build(urdf, "closed-form")
        n = self.bodies.n
        self.arm = spelgen.load_arm(urdf).chain
        coordinates = self.arm.coordinates
        self.lower = np.array([_limit(x.lower, -2.0) for x in coordinates])
        self.upper = np.array([_limit(x.upper, 2.0) for x in coordinates])
        self.speed = np.array([min(x.velocity or 1.5, 3.0) for x in coordinates])
        middle = torch.from_numpy(rng.uniform(self.lower, self.upper, (200, n)))
        with torch.no_grad():
            self.nominal = self.bodies.armature.numpy()
            mass = self._rigid_mass(middle).mean(0)
            gravity = self.bodies.gravity(middle).numpy()
        share = np.exp(rng.uniform(*np.log(SHARE), n))
        size = np.sqrt(gravity.var(axis=0) + (np.diag(mass) * 2.0) ** 2)
        self.coulomb = share * size * (case.friction != "none")
        self.viscous = rng.uniform(0.3, 1.5, n) * share * size / self.speed * (case.friction != "none")
        self.armature = rng.uniform(0.05, 0.5, n) * np.diag(mass) * case.armature
        self.offset = 0.3 * self.coulomb * rng.normal(size=n) * case.offsets
        self.spring = np.zeros(n)
        if case.springs:
            self.spring[rng.integers(n)] = 0.3 * size.max()
        self.asymmetry = 0.3 * rng.normal(size=n) * (case.friction == "asymmetric")

    def _rigid_mass(self, q: torch.Tensor) -> np.ndarray:
        return self.bodies.mass_matrix(q).detach().numpy() - np.diag(self.nominal)

    def mass_matrix(self, q: np.ndarray) -> np.ndarray:
        """M, (T, n, n), with armature."""
        return self._rigid_mass(torch.from_numpy(q)) + np.diag(self.armature)

    def gravity(self, q: np.ndarray) -> np.ndarray:
        """Torque of gravity and springs, (T, n)."""
        own = self.bodies.gravity(torch.from_numpy(q)).detach().numpy()
        return own + self.spring * np.sin(q)

    def friction_torque(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        """Friction along a motion (T, n) on the fine grid."""
        sign = np.tanh(qd / 1e-3)
        dry = self.coulomb * sign
        if self.case.friction == "stribeck":
            dry = dry * (1 + 0.6 * np.exp(-((qd / 0.1) ** 2)))
        elif self.case.friction == "bristles":
            dry = _maxwell_slip(q, self.coulomb)
        elif self.case.friction == "load":
            gravity = np.abs(self.gravity(q))
            dry = dry * (0.6 + 0.8 * gravity / (gravity.mean(axis=0) + TINY))
        return self.viscous * qd + dry * (1 + self.asymmetry * sign)

    def base_error(self, fitted: Fitted, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> float:
        """How far base parameters of bodies and armatures are off, by the torques that they make along a motion."""
        base = base_parameters(self.arm, spelgen.FrictionModel())
        count = 10 * len(self.arm.bodies) + len(self.armature)
        columns = np.concatenate(
            [regressor(self.arm, q, qd, qdd), qdd[:, None] * np.eye(len(self.armature))], axis=2
        )
        inertial = base.columns < count  # those of friction and offsets follow
        size = np.sqrt(np.square(columns[:, :, base.columns[inertial]]).mean(axis=(0, 1)))
        combination = size[:, None] * base.combination[inertial, :count]
        truth = np.concatenate([self.bodies.inertial_parameters.detach().numpy().ravel(), self.armature])
        error = np.concatenate([fitted.bodies.ravel(), fitted.armature]) - truth
        return float(np.linalg.norm(combination @ error) / np.linalg.norm(combination @ truth))

    def torque(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """Joint torques along a motion (T, n) on the fine grid."""
        with torch.no_grad():
            bias = self.bodies.nonlinear_effects(torch.from_numpy(q), torch.from_numpy(qd)).numpy()
        inertial = np.einsum("tij,tj->ti", self.mass_matrix(q), qdd)
        return inertial + bias + self.spring * np.sin(q) + self.friction_torque(q, qd) + self.offset


def _maxwell_slip(q: np.ndarray, coulomb: np.ndarray) -> np.ndarray:
    """Return friction of six elements in parallel that stick up to their own reach and then slip.

    The generalised Maxwell-slip model (Al-Bender et al., IEEE TAC 50:1883, 2005), with other reaches than those
    of the fitted models.
    """
    reaches = np.geomspace(2e-4, 3e-2, 6)
    z = np.zeros((len(reaches), q.shape[1]))
    dry = np.zeros_like(q)
    for k in range(1, len(q)):
        z = np.clip(z + (q[k] - q[k - 1]), -reaches[:, None], reaches[:, None])
        dry[k] = (z / reaches[:, None]).mean(axis=0)
    return coulomb * dry


def _limit(value: float | None, default: float) -> float:
    """A joint's limit as far as a motion goes."""
    return default if value is None else float(np.clip(value, -2.5, 2.5))


def fourier_motion(truth: Truth, seconds: float, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """q, qd and qdd (T, n) of five harmonics a joint, within the joints' ranges and speeds."""
    t = np.arange(0.0, seconds, 1.0 / FINE)[:, None, None]
    n = len(truth.lower)
    omega = 2 * np.pi * np.sort(rng.uniform(0.05, 0.6, (5, n)), axis=0)
    phase, size = rng.uniform(0, 2 * np.pi, (5, n)), rng.uniform(0.3, 1.0, (5, n)) / omega**0.5
    angle = omega * t + phase
    q = (size * np.sin(angle)).sum(1)
    qd = (size * omega * np.cos(angle)).sum(1)
    half = 0.45 * (truth.upper - truth.lower)
    scale = np.minimum(half / np.abs(q).max(0), 0.8 * truth.speed / np.abs(qd).max(0))
    qdd = -(size * omega**2 * np.sin(angle)).sum(1)
    return (truth.lower + truth.upper) / 2 + scale * q, scale * qd, scale * qdd


def pick_and_place(truth: Truth, seconds: float, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """q, qd and qdd (T, n) of quintic moves between random positions, with pauses."""
    parts: list[tuple[np.ndarray, ...]] = []
    count, at = 0, rng.uniform(truth.lower, truth.upper)
    while count < seconds * FINE:
        goal = rng.uniform(truth.lower, truth.upper)
        duration = max(0.6, float((1.875 * np.abs(goal - at) / (0.7 * truth.speed)).max()))
        s = np.arange(0.0, 1.0, 1.0 / (duration * FINE))[:, None]
        shape = 10 * s**3 - 15 * s**4 + 6 * s**5
        rate, change = 30 * s**2 - 60 * s**3 + 30 * s**4, 60 * s - 180 * s**2 + 120 * s**3
        move = at + (goal - at) * shape, (goal - at) * rate / duration, (goal - at) * change / duration**2
        pause = np.zeros((int(rng.uniform(0.2, 0.8) * FINE), len(at)))
        parts += [move, (pause + goal, pause, pause)]
        count, at = count + len(s) + len(pause), goal
    return tuple(np.concatenate(x)[: round(seconds * FINE)] for x in zip(*parts, strict=True))


def record_log(truth: Truth, case: Case, rng: np.random.Generator) -> list[spelgen.Trajectory]:
    """Logs of two motions, as an arm gives them: noisy positions, their differences as velocities, noisy torques."""
    logs = []
    for name in ("first", "second"):
        make = fourier_motion if case.motion == "excitation" else pick_and_place
        q, qd, qdd = make(truth, case.seconds / 2, rng)
        tau = truth.torque(q, qd, qdd)
        shift = round(case.delay * FINE)
        tau = np.concatenate([np.repeat(tau[:1], shift, axis=0), tau[: len(tau) - shift]])
        step = round(FINE / case.sample_rate)
        t = np.arange(0, len(q), step) / FINE
        seen = q[::step] + POSITION_NOISE * rng.normal(size=q[::step].shape)
        noisy = tau[::step] + case.noise * tau.std(axis=0) * rng.normal(size=seen.shape)
        logs.append(spelgen.Trajectory(t, seen, np.gradient(seen, t, axis=0), noisy, name))
    return logs


def wrong_urdf(urdf: Path, error: float, rng: np.random.Generator) -> bytes:
    """Return the URDF with inertials off by this standard deviation; infinite: one placeholder for all."""
    parser = etree.XMLParser(resolve_entities=False, no_network=True, remove_comments=True)
    tree = etree.ElementTree(etree.fromstring(urdf.read_bytes(), parser))
    for name in ("visual", "collision", "dynamics"):
        for element in tree.findall(f".//{name}"):
            element.getparent().remove(element)
    for inertial in tree.findall(".//link/inertial"):
        mass, tensor = inertial.find("mass"), inertial.find("inertia")
        if mass is None or tensor is None or float(mass.get("value", "0")) <= TINY:
            continue
        if np.isinf(error):
            mass.set("value", "1")
            for name in tensor.attrib:
                tensor.set(name, "0.01" if name in ("ixx", "iyy", "izz") else "0")
            for origin in inertial.findall("origin"):
                inertial.remove(origin)
            continue
        by_mass, by_inertia = np.exp(error * rng.normal(size=2))
        value = float(mass.get("value", "0"))
        size = np.sqrt(sum(float(tensor.get(x, "0")) for x in ("ixx", "iyy", "izz")) / 2 / value)
        mass.set("value", repr(float(by_mass * value)))
        for name, entry in tensor.attrib.items():
            tensor.set(name, repr(float(by_mass * by_inertia * float(entry))))
        origin = inertial.find("origin")
        if origin is None:
            origin = etree.SubElement(inertial, "origin")
        center = np.array([float(x) for x in origin.get("xyz", "0 0 0").split()])
        origin.set("xyz", " ".join(repr(float(x)) for x in center + error * size * rng.normal(size=3)))
    return etree.tostring(tree, xml_declaration=True, encoding="utf-8")


def random_arm(rng: np.random.Generator) -> bytes:
    """A chain of three to seven joints with random axes, offsets and solid bodies, as URDF."""
    robot = etree.Element("robot", name="random")
    etree.SubElement(robot, "link", name="base")
    joints, parent = int(rng.integers(3, 8)), "base"
    for k in range(joints):
        link = etree.SubElement(robot, "link", name=f"link{k + 1}")
        mass, sides = 8.0 * 0.6**k * np.exp(0.3 * rng.normal()), rng.uniform(0.05, 0.3, 3)
        inertial = etree.SubElement(link, "inertial")
        center = rng.normal(size=3) * 0.05 + [0, 0, 0.1]
        etree.SubElement(inertial, "origin", xyz=" ".join(map(repr, map(float, center))))
        etree.SubElement(inertial, "mass", value=repr(float(mass)))
        moments = mass / 12 * (np.square(sides).sum() - np.square(sides))
        names = dict(zip(("ixx", "iyy", "izz"), (repr(float(x)) for x in moments), strict=True))
        etree.SubElement(inertial, "inertia", names | {"ixy": "0", "ixz": "0", "iyz": "0"})
        joint = etree.SubElement(robot, "joint", name=f"joint{k + 1}", type="revolute")
        turn = " ".join(repr(float(x)) for x in rng.choice([0.0, np.pi / 2, -np.pi / 2], 3))
        offset = " ".join(repr(float(x)) for x in [0.0, rng.normal() * 0.03, 0.2 + 0.1 * rng.random()])
        etree.SubElement(joint, "origin", xyz=offset, rpy=turn)
        etree.SubElement(joint, "parent", link=parent)
        etree.SubElement(joint, "child", link=f"link{k + 1}")
        etree.SubElement(joint, "axis", xyz="0 0 1")
        etree.SubElement(joint, "limit", lower="-2.5", upper="2.5", velocity="2.5", effort="200")
        parent = f"link{k + 1}"
    return etree.tostring(robot)


def run_case(case: Case, folder: Path) -> dict[str, Any]:
    """Fit everything to one case; errors by method."""
    rng = np.random.default_rng([case.number, 1])
    with tempfile.TemporaryDirectory() as temporary:
        given = Path(temporary) / "given.urdf"
        if case.arm == "random":
            urdf = Path(temporary) / "random.urdf"
            urdf.write_bytes(random_arm(rng))
        else:
            urdf = folder / f"{case.arm}.urdf"
        given.write_bytes(wrong_urdf(urdf, case.urdf_error, rng))
        try:
            truth = Truth(case, urdf, rng)
        except SpelgenError as error:  # two arms in one URDF, for one
            return asdict(case) | {"n": 0, "results": {name: {"error": str(error)} for name in METHODS}}
        logs = record_log(truth, case, rng)
        test = fourier_motion(truth, 10.0, rng)
        results: dict[str, Any] = {}
        for name, fit in METHODS.items():
            since = time.process_time()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                try:
                    results[name] = measure(fit(given, logs), truth, test)
                except SpelgenError as error:
                    results[name] = {"error": str(error)}
            results[name]["seconds"] = round(time.process_time() - since, 2)
        return asdict(case) | {"n": truth.bodies.n, "results": results}


def measure(fitted: Fitted, truth: Truth, test: tuple[np.ndarray, ...]) -> dict[str, Any]:
    """How far fitted dynamics are from the truth."""
    every, dynamics = round(FINE / 100.0), fitted.dynamics
    q, qd, qdd = (x[::every] for x in test)
    states = [torch.from_numpy(np.ascontiguousarray(x)) for x in (q, qd, qdd)]
    with torch.no_grad():
        mass = np.asarray(dynamics.mass_matrix(states[0][::10]))
        gravity = np.asarray(dynamics.gravity(states[0]))
        past: tuple[torch.Tensor, ...] = ()
        if getattr(dynamics, "elements", 0):
            past = (memory_along(dynamics, states[0][None], states[1][None])[0],)
        tau = np.asarray(dynamics.inverse_dynamics(*states, *past))
        friction = np.asarray(dynamics.friction_torque(*states[:2], *past))
    true_mass, true_gravity = truth.mass_matrix(q[::10]), truth.gravity(q)
    true_tau, true_friction = truth.torque(*test)[::every], truth.friction_torque(*test[:2])[::every]
    norm = np.linalg.norm(mass - true_mass, axis=(1, 2)) / np.linalg.norm(true_mass, axis=(1, 2))
    diagonal = np.einsum("tii->ti", mass - true_mass).mean(0) / np.einsum("tii->ti", true_mass).mean(0)
    low_pass = butter(4, 8.0, fs=100.0, output="sos")
    missed, slow = tau - true_tau, sosfiltfilt(low_pass, true_tau, axis=0)
    varying = friction - friction.mean(0) - (true_friction - true_friction.mean(0))
    nmse = (missed**2).mean(0) / true_tau.var(0)
    filtered = (sosfiltfilt(low_pass, missed, axis=0) ** 2).mean(0) / slow.var(0)
    return {
        "mass": float(norm.mean()),
        "diagonal": [round(float(x), 5) for x in diagonal],
        "base": truth.base_error(fitted, q, qd, qdd),
        "gravity": float(np.sqrt(((gravity - true_gravity) ** 2).mean() / ((true_gravity**2).mean() + TINY))),
        "friction": float(np.sqrt((varying**2).mean() / (true_friction.var(0).mean() + TINY))),
        "nmse": float(nmse.mean()),
        "nmse_filtered": float(filtered.mean()),
    }


@dataclass(frozen=True, eq=False)
class Fitted:
    """Hold fitted dynamics, and their constants: bodies (B, 10) about the joints' frames, armatures (n,)."""

    dynamics: Any
    bodies: np.ndarray
    armature: np.ndarray


def fit_hybrid(urdf: Path, logs: list[spelgen.Trajectory]) -> Fitted:
    """The default model, fitted to torques as `spelgen train` does, without its measurement of windows."""
    model = spelgen.build(urdf, "hybrid")
    late = torque_delay(model, logs, spelgen.Preprocessing())
    moved = spelgen.Preprocessing(torque_delay=late.delay)
    fit_torque(model, dynamics_samples(logs, preprocessing=moved, reach=bristle_reach(model)))
    with torch.no_grad():
        return Fitted(model, model.inertial_parameters.numpy(), model.armature.numpy())


def fit_least_squares(memory: bool) -> Callable[[Path, list[spelgen.Trajectory]], Fitted]:
    """A function that identifies the arm by least squares."""

    def fit(urdf: Path, logs: list[spelgen.Trajectory]) -> Fitted:
        method = spelgen.LeastSquares(friction=spelgen.FrictionModel(memory=memory))
        result = spelgen.identify(spelgen.load_arm(urdf), logs, method)
        bodies, armature, _ = np.split(
            result.parameters, np.cumsum([10 * len(result.arm.bodies), len(result.arm.coordinates)])
        )
        return Fitted(result.dynamics, bodies, armature)

    return fit


def fit_figaroh(urdf: Path, logs: list[spelgen.Trajectory]) -> Fitted:
    """Identify the arm by figaroh, from samples moved by the delay that `identify` finds."""
    loaded = spelgen.load_arm(urdf)
    delay = spelgen.identify(loaded, logs).torque_delay.delay
    samples = dynamics_samples(logs, preprocessing=spelgen.Preprocessing(torque_delay=delay))
    dynamics = figaroh_dynamics(loaded.chain, loaded.settings, samples)
    return Fitted(dynamics, dynamics.inertial_parameters, dynamics.armature)


METHODS = {
    "hybrid": fit_hybrid,
    "identify": fit_least_squares(memory=False),
    "identify --memory": fit_least_squares(memory=True),
}
OURS = tuple(METHODS)
if importlib.util.find_spec("figaroh"):
    METHODS["figaroh"] = fit_figaroh


def usable_arms(folder: Path) -> list[str]:
    """Arms whose moving links all have inertials that bodies can have."""
    names = []
    for path in sorted(folder.glob("*.urdf")):
        tree = etree.parse(path)
        masses = [float(x.get("value", "0")) for x in tree.findall(".//link/inertial/mass")]
        if len(masses) >= 4 and min(masses[1:]) > 1e-3 and len({round(x, 9) for x in masses}) > 2:
            names.append(path.stem)
    return names


def summary(rows: Sequence[dict[str, Any]]) -> str:
    """Medians by method, and how often the default is near the better least squares."""
    lines = [
        f"{'':20}{'M':>10}{'g':>10}{'base':>10}{'friction':>10}"
        f"{'nMSE':>12}{'filtered':>12}{'worst Mjj':>11}{'s':>7}{'arms':>7}"
    ]
    good = [row for row in rows if not any("error" in row["results"][name] for name in OURS)]
    for name in METHODS:
        each = [row["results"][name] for row in good if "mass" in row["results"].get(name, {})]
        columns = [np.median([x[key] for x in each]) for key in ("mass", "gravity", "base", "friction")]
        errors = [np.median([x[key] for x in each]) for key in ("nmse", "nmse_filtered")]
        worst = np.median([np.abs(x["diagonal"]).max() for x in each])
        seconds = np.median([x["seconds"] for x in each])
        lines.append(
            f"{name:20}" + "".join(f"{x:10.4f}" for x in columns) + "".join(f"{x:12.2e}" for x in errors)
            + f"{worst:11.4f}{seconds:7.1f}{len(each):7}"
        )  # fmt: skip
    for key in ("mass", "nmse"):
        ratio = np.array([by_better_least_squares(row, key) for row in good])
        lines.append(
            f"{key}: hybrid by the better least squares: median {np.median(ratio):.2f}; "
            + ", ".join(f"at most {most} on {100 * (ratio <= most).mean():.0f} %" for most in (1.2, 1.02, 1))
            + f" of {len(good)}"
        )
        for cause in ("urdf_error", "friction", "motion", "seconds", "sample_rate", "noise"):
            values = [row[cause] for row in good]
            medians = [
                f"{value}: {np.median(ratio[[x == value for x in values]]):.2f}"
                for value in sorted(set(values))
            ]
            lines.append(f"    median by {cause}: " + ", ".join(medians))
    failed = len(rows) - len(good)
    return "\n".join([*lines, f"{failed} cases with an error"])


def by_better_least_squares(row: dict[str, Any], key: str) -> float:
    """Return an error of the default model, by the error of the better of both least squares."""
    errors = {name: row["results"][name][key] for name in OURS}
    return float(errors["hybrid"] / min(errors["identify"], errors["identify --memory"]))


PANDA = Case(
    1_000_000, "panda_erd", 0.25, "coulomb", True, False, False, "excitation", 40.0, 200.0, 0.03, 0.0
)


def _work(task: tuple[Case, Path]) -> dict[str, Any]:
    torch.set_num_threads(1)
    return run_case(*task)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--arms", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--out", type=Path, default=Path("runs/truth.jsonl"))
    parser.add_argument(
        "--arms-folder", type=Path, default=ARMS, help="URDFs; without them all arms are random"
    )
    parser.add_argument("--panda", action="store_true")
    options = parser.parse_args()
    rows = [json.loads(x) for x in options.out.read_text().splitlines()] if options.out.exists() else []
    names = usable_arms(options.arms_folder) if options.arms_folder.is_dir() else []
    cases = [draw_case(k, names) for k in range(options.first, options.first + options.arms)]
    cases = ([PANDA] if options.panda else []) + cases
    options.out.parent.mkdir(parents=True, exist_ok=True)
    done = {row["number"] for row in rows}
    tasks = [(case, options.arms_folder) for case in cases if case.number not in done]
    with multiprocessing.get_context("spawn").Pool(options.jobs) as pool, options.out.open("a") as file:
        for row in pool.imap_unordered(_work, tasks):
            rows.append(row)
            file.write(json.dumps(row) + "\n")
            file.flush()
    numbers = {case.number for case in cases}
    print(summary([row for row in rows if row["number"] in numbers]))
    for row in rows:
        if row["number"] == PANDA.number and options.panda:
            print(json.dumps(row["results"], indent=1))


if __name__ == "__main__":
    main()
