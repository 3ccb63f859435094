"""Fit simulated arms whose truth is known, and measure the errors of each method.

    python benchmarks/truth.py [--arms 100] [--first 0] [--jobs 2] [--out runs/truth.jsonl] [--panda]
                               [--recordings FOLDER]

A case is random, with its number as seed: an arm (a real URDF or a random chain), the error of the given URDF,
friction of one of six kinds, armature, offsets, springs, a motion, a sample rate, noise and a delay of the torques.
From number 10,000 on, half of the cases have the errors of real arms in addition (`real_errors.py`). The default
preset, `hybrid`, least squares with Coulomb friction and with bristle states, and figaroh's weighted least squares if
it is installed, are fitted to the same samples. Results are appended to a file of JSON lines; a run continues where it
stopped. `--panda` adds a simulated Panda with 40 s of logs at 200 Hz and 3 % noise.

The errors are measured along a test motion without noise. A star marks a true value, rms is the root mean square:

- M: mean of |M - M*| / |M*| (Frobenius norm); also the relative error of each diagonal entry's mean, of which the
  largest is printed;
- g: rms(g - g*) / rms(g*);
- base parameters b: |w (b - b*)| / |w b*|, with the weight w = rms of each parameter's column of the regressor;
- friction f: rms(f - f*) / rms(f*), after the mean of each joint (the offset) is subtracted from f and f*;
- torque: nMSE (mean squared error / variance of the torque, mean over joints), unfiltered and low-passed at 8 Hz.

True values are values that sensors without noise would log. The sensors of some cases have wrong torque units (logged
torque = gain * torque) and wrong zero positions (logged q = q + zero): M*, g* and torques are then gain * M(q - zero),
and so on, at the logged q. No base parameters reproduce such torques exactly. The true base parameters are therefore
the least-squares solution for the logged rigid torque of the test motion (the pseudo-true parameters of a misspecified
model; White, Econometrica 50:1, 1982). Their regressor has the motion of the links plus the zero offsets. It does not
have the motion of the motors, although encoders measure it: backlash causes peaks in the acceleration of motors, and a
regression on these peaks has a bias that fits to filtered logs do not have.

Intervals: 95 % intervals of the default preset, see `intervals.py`. Residuals: correlation and spectrum, compared with
the residuals of recordings if their folder is given.
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
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lxml import etree
from scipy.signal import butter, sosfiltfilt

sys.path.insert(0, str(Path(__file__).parent))

from figaroh_identification import figaroh_dynamics
from intervals import SteadySliding, TrueValues, interval_ratios
from real_errors import ErrorProcess, RealErrors, draw_errors, play
from residual_statistics import residual_statistics
from truth_summary import summary

import spelgen
from spelgen.dynamics.bristles import reach_of
from spelgen.dynamics.protocol import is_stateful, memory_along
from spelgen.dynamics.regressor_dynamics import regressor
from spelgen.errors import SpelgenError
from spelgen.evaluation.torque import predicted_torques
from spelgen.fitting.posterior import Posterior
from spelgen.identification.base_parameters import base_parameters
from spelgen.logs.dynamics_samples import dynamics_samples

ARMS = (
    Path(__file__).parents[2] / "shared" / "arms"
)  # folder of URDFs next to the checkout; without it all arms are random chains
FRICTIONS = ("none", "coulomb", "stribeck", "bristles", "load", "asymmetric")
FINE = 1000.0  # [Hz] rate of the simulation; logs are a subset of its samples
POSITION_NOISE = 1e-5  # [rad, m] standard deviation of encoder noise, as of an encoder with 18 bits
SHARE = (0.03, 0.15)  # [1] Coulomb friction relative to the rigid torque's standard deviation, log-uniform
TINY = 1e-9
FIRST_REALISTIC = 10_000
UNEXCITED = 1e-3  # [1] ridge penalty of pseudo-true parameters, relative to their columns' squared length
BRISTLES = np.geomspace(2e-4, 3e-2, 6)[
    :, None
]  # [rad, m] break-away displacements of the simulated bristles, which differ from the fitted model's
Motion = tuple[np.ndarray, np.ndarray, np.ndarray]
"""q, qd and qdd, each (T, n)."""


@dataclass(frozen=True)
class Case:
    """One random case: an arm, the errors of its URDF, its friction and drives, and the conditions of its logs."""

    number: int
    arm: str
    urdf_error: float  # [1] relative standard deviation of the URDF's inertials; infinite: dummy inertials
    friction: str
    armature: bool
    offsets: bool
    springs: bool
    motion: str
    seconds: float
    sample_rate: float
    noise: float
    delay: float  # [s] delay of the logged torques
    errors: RealErrors | None = None


def draw_case(number: int, arms: Sequence[str]) -> Case:
    """Return the random case with this number as seed; arms: names of URDFs that it may use."""
    rng = np.random.default_rng(number)
    random_arm = rng.random() < 0.2 or not arms
    case = Case(
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
    if number >= FIRST_REALISTIC and rng.random() < 0.5:
        case = replace(case, errors=draw_errors(rng))
    return case


class Truth:
    """The simulated arm of a case: the URDF's rigid bodies, and friction, drives, springs and errors of the case."""

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
        self.inertia = np.diag(mass)
        share = np.exp(rng.uniform(*np.log(SHARE), n))
        size = np.sqrt(gravity.var(axis=0) + (self.inertia * 2.0) ** 2)
        self.coulomb = share * size * (case.friction != "none")
        self.viscous = rng.uniform(0.3, 1.5, n) * share * size / self.speed * (case.friction != "none")
        self.armature = rng.uniform(0.05, 0.5, n) * self.inertia * case.armature
        self.offset = 0.3 * self.coulomb * rng.normal(size=n) * case.offsets
        self.spring = np.zeros(n)
        if case.springs:
            joint = rng.integers(n)
            # the spring has the torque `spring` sin(q) at one joint, like gravity of a pendulum that hangs at q = 0
            self.spring[joint] = 0.3 * size[joint]
        self.asymmetry = 0.3 * rng.normal(size=n) * (case.friction == "asymmetric")
        self.load = np.abs(gravity + self.spring * np.sin(middle.numpy())).mean(axis=0)
        own_rng = np.random.default_rng([case.number, 2])
        self.process = ErrorProcess(case.errors or RealErrors(), share * size, own_rng)

    def _rigid_mass(self, q: torch.Tensor) -> np.ndarray:
        return self.bodies.mass_matrix(q).detach().numpy() - np.diag(self.nominal)

    def _rigid_torque(self, motion: Motion) -> np.ndarray:
        """Return the torque of inertia, Coriolis and gravity of the rigid bodies without armatures, (T, n) [Nm, N].

        motion: q, qd and qdd of the links, (T, n) each, on the link's side of elastic joints and gears.
        """
        q, qd, qdd = motion
        with torch.no_grad():
            bias = self.bodies.nonlinear_effects(torch.from_numpy(q), torch.from_numpy(qd)).numpy()
        return np.einsum("tij,tj->ti", self._rigid_mass(torch.from_numpy(q)), qdd) + bias

    def mass_matrix(self, q: np.ndarray) -> np.ndarray:
        """Return M with armatures at logged positions q (T, n), (T, n, n) [kg m^2, kg].

        The row of each joint is multiplied by `gain`, the factor from its true torque to its logged torque.
        """
        mass = self._rigid_mass(torch.from_numpy(q - self.process.zero)) + np.diag(self.armature)
        return self.process.gain[:, None] * mass

    def gravity(self, q: np.ndarray) -> np.ndarray:
        """Return the torque of gravity and springs as a sensor would log it, (T, n) [Nm, N].

        It is the true torque times `process.gain`, the factor from true to logged torques. q: (T, n) logged positions
        [rad, m], including zero offsets.
        """
        return self.process.gain * self._gravity(q - self.process.zero)

    def _gravity(self, q: np.ndarray) -> np.ndarray:
        own = self.bodies.gravity(torch.from_numpy(q)).detach().numpy()
        return own + self.spring * np.sin(q)

    def friction_torque(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        """Return the true friction torque along a motion of the motors, (T, n) [Nm, N].

        q, qd: (T, n) true positions and velocities at the rate `FINE`. Friction of bristles depends on past positions.
        """
        if self.case.friction == "bristles":
            return self._friction(q, qd, play(q, BRISTLES))
        return self._friction(q, qd, np.tanh(qd / 1e-3))

    def _friction(self, q: np.ndarray, qd: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return viscous plus dry friction at true positions and velocities, (T, n) [Nm, N].

        direction: (T, n), dry friction relative to its magnitude while sliding, -1..1; fractions during a reversal.
        """
        dry = self.coulomb * direction * self.process.friction_factor(q)
        if self.case.friction == "stribeck":
            dry = dry * (1 + 0.6 * np.exp(-((qd / 0.1) ** 2)))
        elif self.case.friction == "load":
            dry = dry * (0.6 + 0.8 * np.abs(self._gravity(q)) / (self.load + TINY))
        return self.viscous * qd + dry * (1 + self.asymmetry * direction)

    def sliding_friction(self, sliding: SteadySliding) -> np.ndarray:
        """Return the friction of steady sliding as a sensor would log it, (speeds, n) [Nm, N].

        It is the true friction times `process.gain`, the factor from true to logged torques. sliding: speeds, and
        logged positions over which friction is averaged.
        """
        q = sliding.q - self.process.zero
        rows = []
        for speed in sliding.speeds:
            qd, direction = np.broadcast_to(speed, q.shape), np.ones_like(q)
            both = self._friction(q, qd, direction) - self._friction(q, -qd, -direction)
            rows.append(self.process.gain * (both.mean(axis=0) / 2 + self.process.cable))
        return np.stack(rows)

    def sensed(
        self, motion: Motion, temperature: np.ndarray | float = 1.0
    ) -> tuple[Motion, np.ndarray, np.ndarray]:
        """Return the motion of the motors, their torque, and the friction in this torque, as logged without noise.

        All arrays are (T, n). Positions include the zero offsets of the case, torques are multiplied by its `gain`.

        Args:
            motion: motion of the links, at the rate `FINE`; motors deviate from it by the deflection of the joints.
            temperature: factor on friction, (T, n) or one number.
        """
        q, qd, qdd = motion
        link = self._rigid_torque(motion) + self.spring * np.sin(q)
        if self.case.errors:
            # motors move relative to the links; rates of the deflection are computed by finite differences
            twist = self.process.deflection(link, self.inertia)
            rate = np.gradient(twist, 1 / FINE, axis=0)
            q, qd, qdd = q + twist, qd + rate, qdd + np.gradient(rate, 1 / FINE, axis=0)
        friction = self.friction_torque(q, qd) * temperature + self.process.hysteresis(q)
        torque = link + self.armature * qdd + friction + self.offset + self.process.ripple(q)
        gain = self.process.gain
        return (q + self.process.zero, qd, qdd), gain * torque, gain * friction

    def inertial_columns(self, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
        """Return the regressor of base parameters along a motion, without friction and offsets.

        Returns: (r, K) matrix from inertial parameters and armatures to base parameters, and columns (T, n, r).
        """
        q, qd, qdd = motion
        base = base_parameters(self.arm, spelgen.FrictionModel())
        count = 10 * len(self.arm.bodies) + len(self.armature)
        columns = np.concatenate(
            [regressor(self.arm, q, qd, qdd), qdd[:, None] * np.eye(len(self.armature))], axis=2
        )
        inertial = base.columns < count  # base parameters of friction and offsets are omitted
        return base.combination[inertial, :count], columns[:, :, base.columns[inertial]]

    def base_parameters(self, motion: Motion, combination: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return the true base parameters, (r,).

        If the case has `errors`, logged torques have wrong units and logged positions have zero offsets. The result is
        then the least-squares solution for logged torques and positions (see the module).

        Args:
            motion: test motion of the links, with true positions; logged positions are these plus the zero offsets.
            combination: (r, K) matrix from K inertial parameters and armatures to base parameters, the first result of
                `inertial_columns`.
            columns: (T, n, r) regressor of the base parameters at the logged positions, its second result.
        """
        bodies = self.bodies.inertial_parameters.detach().numpy().ravel()
        exact = combination @ np.concatenate([bodies, self.armature])
        if self.case.errors is None:
            return np.asarray(exact)
        torque = self.process.gain * (self._rigid_torque(motion) + self.armature * motion[2])
        scale = torque.std(axis=0) + TINY
        rows = (columns / scale[:, None]).reshape(-1, columns.shape[2])
        length = np.linalg.norm(rows, axis=0) + TINY
        # the ridge penalty keeps the exact values of parameters that the test motion does not excite
        rows = np.vstack([rows / length, np.sqrt(UNEXCITED) * np.eye(len(length))])
        residual = ((torque - columns @ exact) / scale).ravel()
        change = np.linalg.lstsq(rows, np.append(residual, np.zeros(len(length))), rcond=None)[0]
        return np.asarray(exact + change / length)


def _limit(value: float | None, default: float) -> float:
    """Return a position limit of the simulated motion [rad, m]: the URDF's, clipped to +-2.5, or else the default."""
    return default if value is None else float(np.clip(value, -2.5, 2.5))


def fourier_motion(truth: Truth, seconds: float, rng: np.random.Generator) -> Motion:
    """Return a random motion of the links at the rate `FINE`: five sines per joint, within its range and speed."""
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


def pick_and_place(truth: Truth, seconds: float, rng: np.random.Generator) -> Motion:
    """Return a motion of the links at the rate `FINE`: quintic polynomials between random positions, with pauses."""
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
    q, qd, qdd = (np.concatenate(x)[: round(seconds * FINE)] for x in zip(*parts, strict=True))
    return q, qd, qdd


def record_log(truth: Truth, case: Case, rng: np.random.Generator) -> list[spelgen.Trajectory]:
    """Simulate two motions of a case; return logs of noisy positions and torques, with finite differences as qd."""
    logs, own_rng, process = [], np.random.default_rng([case.number, 3]), truth.process
    for name in ("first", "second"):
        make = fourier_motion if case.motion == "excitation" else pick_and_place
        motion = make(truth, case.seconds / 2, rng)
        warmth = process.temperature_factor(np.arange(len(motion[0])) / FINE, own_rng)
        (q, _, _), tau, _ = truth.sensed(motion, warmth)
        shift = round(case.delay * FINE)
        tau = np.concatenate([np.repeat(tau[:1], shift, axis=0), tau[: len(tau) - shift]])
        tau = process.sensed(tau, FINE, own_rng)
        step = round(FINE / case.sample_rate)
        t = np.arange(0, len(q), step) / FINE
        seen = process.encoded(q[::step] + POSITION_NOISE * rng.normal(size=q[::step].shape))
        noisy = tau[::step] + case.noise * tau.std(axis=0) * rng.normal(size=seen.shape)
        logs.append(spelgen.Trajectory(t, seen, np.gradient(seen, t, axis=0), noisy, name))
    return logs


def wrong_urdf(urdf: Path, error: float, rng: np.random.Generator) -> bytes:
    """Return the URDF with random errors of its inertials, as text.

    error: relative standard deviation; infinite: all masses 1 kg and all inertias 0.01 kg m^2, as in a draft.
    """
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
    """Return the URDF of a random chain of three to seven turning joints, with box-shaped bodies, as text."""
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
    """Simulate a case, fit each method to its logs, and return the case and the errors by method."""
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
        except SpelgenError as error:  # the package rejects the URDF, for example one with two arms
            return asdict(case) | {"n": 0, "results": {name: {"error": str(error)} for name in METHODS}}
        logs = record_log(truth, case, rng)
        test = fourier_motion(truth, 10.0, rng)
        results: dict[str, Any] = {}
        for name, fit in METHODS.items():
            since = time.process_time()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                try:
                    fitted = fit(given, logs)
                    seconds = time.process_time() - since
                    results[name] = measure(fitted, truth, test) | {"residual": fitted.residual}
                except SpelgenError as error:
                    seconds = time.process_time() - since
                    results[name] = {"error": str(error)}
            results[name]["seconds"] = round(seconds, 2)
        return asdict(case) | {"n": truth.bodies.n, "results": results}


def measure(fitted: Fitted, truth: Truth, motion: Motion) -> dict[str, Any]:
    """Return {name: error} of fitted dynamics along a test motion of the links; errors are relative (see the module).

    Names: "mass" (M), "diagonal" (mean of each M_jj), "base" (base parameters), "gravity", "friction", "nmse" and
    "nmse_filtered" (torque), and "intervals" (`interval_ratios`) if the fit has a posterior.
    """
    every, dynamics = round(FINE / 100.0), fitted.dynamics
    sensed, true_tau, true_friction = truth.sensed(motion)
    q, qd, qdd = (np.ascontiguousarray(x[::every]) for x in sensed)
    true_tau, true_friction = true_tau[::every], true_friction[::every]
    states = [torch.from_numpy(x) for x in (q, qd, qdd)]
    with torch.no_grad():
        mass = np.asarray(dynamics.mass_matrix(states[0][::10]))
        gravity = np.asarray(dynamics.gravity(states[0]))
        past: tuple[torch.Tensor, ...] = ()
        if is_stateful(dynamics):
            past = (memory_along(dynamics, states[0][None], states[1][None])[0],)
        tau = np.asarray(dynamics.inverse_dynamics(*states, *past))
        friction = np.asarray(dynamics.friction_torque(*states[:2], *past))
    true_mass, true_gravity = truth.mass_matrix(q[::10]), truth.gravity(q)
    norm = np.linalg.norm(mass - true_mass, axis=(1, 2)) / np.linalg.norm(true_mass, axis=(1, 2))
    diagonal = np.einsum("tii->ti", mass - true_mass).mean(0) / np.einsum("tii->ti", true_mass).mean(0)
    low_pass = butter(4, 8.0, fs=100.0, output="sos")
    residual, slow = tau - true_tau, sosfiltfilt(low_pass, true_tau, axis=0)
    varying = friction - friction.mean(0) - (true_friction - true_friction.mean(0))
    nmse = (residual**2).mean(0) / true_tau.var(0)
    filtered = (sosfiltfilt(low_pass, residual, axis=0) ** 2).mean(0) / slow.var(0)
    links = motion[0][::every], motion[1][::every], motion[2][::every]
    combination, columns = truth.inertial_columns((links[0] + truth.process.zero, *links[1:]))
    true_base = truth.base_parameters(links, combination, columns)
    size = np.sqrt(np.square(columns).mean(axis=(0, 1)))
    base = combination @ np.concatenate([fitted.bodies.ravel(), fitted.armature])
    errors: dict[str, Any] = {
        "mass": float(norm.mean()),
        "diagonal": [round(float(x), 5) for x in diagonal],
        "base": float(np.linalg.norm(size * (base - true_base)) / np.linalg.norm(size * true_base)),
        "gravity": float(np.sqrt(((gravity - true_gravity) ** 2).mean() / ((true_gravity**2).mean() + TINY))),
        "friction": float(np.sqrt((varying**2).mean() / (true_friction.var(0).mean() + TINY))),
        "nmse": float(nmse.mean()),
        "nmse_filtered": float(filtered.mean()),
    }
    if fitted.posterior is not None:
        sliding = SteadySliding(q[::100], np.quantile(np.abs(qd), (0.5, 0.9), axis=0))
        values = TrueValues(
            combination, true_base, truth.sliding_friction(sliding), true_mass[::20], true_gravity[::200]
        )
        errors["intervals"] = interval_ratios(fitted.posterior, values, sliding, q[::200])
    return errors


@dataclass(frozen=True, eq=False)
class Fitted:
    """Dynamics that one of `METHODS` has fitted, and their parameters.

    bodies: inertial parameters, (B, 10), in the frames of the joints. armature: (n,) [kg m^2, kg]. posterior: only for
    the method "hybrid". residual: statistics of the torque residual in the training logs (`residual_of`), only for the
    method "identify --memory".
    """

    dynamics: Any
    bodies: np.ndarray
    armature: np.ndarray
    posterior: Posterior | None = None
    residual: list[float] | None = None


def fit_hybrid(urdf: Path, logs: list[spelgen.Trajectory]) -> Fitted:
    """Fit the preset `hybrid` to torques, as `spelgen train` does."""
    fit = spelgen.fit(spelgen.build(urdf, "hybrid"), logs, spelgen.TorqueFit(), arm=urdf)
    model = fit.model.requires_grad_(False)
    return Fitted(model, model.inertial_parameters.numpy(), model.armature.numpy(), fit.posterior)


def fit_least_squares(memory: bool) -> Callable[[Path, list[spelgen.Trajectory]], Fitted]:
    """Return a function that identifies an arm from logs by least squares; memory: with bristle states."""

    def fit(urdf: Path, logs: list[spelgen.Trajectory]) -> Fitted:
        method = spelgen.LeastSquares(friction=spelgen.FrictionModel(memory=memory))
        result = spelgen.identify(spelgen.load_arm(urdf), logs, method)
        bodies, armature, _ = np.split(
            result.parameters, np.cumsum([10 * len(result.arm.bodies), len(result.arm.coordinates)])
        )
        return Fitted(result.dynamics, bodies, armature, residual=residual_of(result, logs))

    return fit


def residual_of(result: spelgen.Identification, logs: list[spelgen.Trajectory]) -> list[float] | None:
    """Return `ResidualStatistics.columns` (level, correlation, spectrum) of the torque residual of an identification.

    The residual is on the logs of the identification. Return None if the identified friction has no bristle states, or
    if all logs are shorter than 4 s.
    """
    if not result.method.friction.memory:
        return None
    samples = dynamics_samples(
        logs,
        pauses=True,
        preprocessing=spelgen.Preprocessing(torque_delay=result.torque_delay.delay),
        reach=reach_of(result.arm.joint_types),
    )
    residuals = [predicted_torques(result.dynamics, x) - x.tau for x in samples]
    statistics = residual_statistics(residuals, [x.tau for x in samples])
    return None if statistics is None else statistics.columns()


def fit_figaroh(urdf: Path, logs: list[spelgen.Trajectory]) -> Fitted:
    """Identify the arm with figaroh, from samples without the torque delay, which `spelgen.identify` estimates."""
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
if importlib.util.find_spec("figaroh"):
    METHODS["figaroh"] = fit_figaroh


def usable_arms(folder: Path) -> list[str]:
    """Return the names of URDFs in a folder whose moving links all have masses above 1 g, not all of them equal."""
    names = []
    for path in sorted(folder.glob("*.urdf")):
        tree = etree.parse(path)
        masses = [float(x.get("value", "0")) for x in tree.findall(".//link/inertial/mass")]
        if len(masses) >= 4 and min(masses[1:]) > 1e-3 and len({round(x, 9) for x in masses}) > 2:
            names.append(path.stem)
    return names


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
    parser.add_argument("--recordings", type=Path, help="folder of recordings, to compare residuals with")
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
    print(summary([row for row in rows if row["number"] in numbers], list(METHODS), options.recordings))
    for row in rows:
        if row["number"] == PANDA.number and options.panda:
            print(json.dumps(row["results"], indent=1))


if __name__ == "__main__":
    main()
