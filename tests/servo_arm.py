"""An arm of two links in a vertical plane under position servos, simulated by itself in small steps."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spelgen.logs.trajectory import Trajectory

LINK = """<link name="{name}"><inertial><origin xyz="0 0 -{com}"/><mass value="{mass}"/>
<inertia ixx="{inertia}" iyy="{inertia}" izz="1e-5" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/><axis xyz="0 1 0"/>
<origin xyz="0 0 {z}"/><limit lower="-3" upper="3" effort="6" velocity="5"/></joint>"""
LENGTH, COM, MASS, INERTIA = 0.2, np.array([0.1, 0.08]), np.array([0.3, 0.2]), np.array([1.2e-3, 6e-4])
GRAVITY, STEP = 9.81, 5e-4


@dataclass(frozen=True)
class Servos:
    """What is to be found: kp, kd, armature and dry friction of both joints, delay [s]."""

    kp: tuple[float, float] = (14.0, 9.0)
    kd: tuple[float, float] = (0.9, 0.5)
    armature: tuple[float, float] = (0.03, 0.012)
    coulomb: tuple[float, float] = (0.15, 0.08)
    delay: float = 0.03


def write_servo_arm(folder: Path, settings: str = "input: position\n") -> Path:
    """The URDF, with its settings beside it."""
    links = [
        LINK.format(name=name, com=com, mass=mass, inertia=inertia)
        for name, com, mass, inertia in zip(("upper", "lower"), COM, MASS, INERTIA, strict=True)
    ]
    joints = [
        JOINT.format(name="shoulder", parent="base", child="upper", z=0),
        JOINT.format(name="elbow", parent="upper", child="lower", z=-LENGTH),
    ]
    path = folder / "servo_arm.urdf"
    path.write_text(f'<robot name="servo_arm"><link name="base"/>{"".join(links + joints)}</robot>')
    path.with_suffix(".yaml").write_text(settings)
    return path


def servo_logs(
    count: int, seconds: float, servos: Servos = Servos(), seed: int = 0, swing: float = 1.0
) -> list[Trajectory]:
    """Recordings at 50 Hz of commands that swing, hold and jump; positions come in steps of an encoder's 4096."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 0.02)
    u = np.stack([_commands(rng, t, swing) for _ in range(count)])
    q = _simulated(t, u, servos)
    q = np.round(q * 4096 / (2 * np.pi)) * (2 * np.pi / 4096)
    nothing = np.zeros((len(t), 0))
    return [
        Trajectory(t, x, np.gradient(x, t, axis=0), nothing, name=f"motion {k}", u=u[k])
        for k, x in enumerate(q)
    ]


def _commands(rng: np.random.Generator, t: np.ndarray, swing: float) -> np.ndarray:
    """(T, 2)"""
    waves = sum(
        rng.uniform(0.05, 0.3)
        * np.sin(2 * np.pi * rng.uniform(0.05, 1.2, 2) * t[:, None] + rng.uniform(0, 6, 2))
        for _ in range(3)
    )
    levels = rng.uniform(-0.5, 0.5, (int(t[-1] / 2) + 1, 2))[(t / 2).astype(int)]
    return np.asarray(swing * waves + levels)


def _simulated(t: np.ndarray, u: np.ndarray, servos: Servos) -> np.ndarray:
    """Positions (B, T, 2): semi-implicit Euler, dry friction as the impulse that stops a joint or is at its limit."""
    kp, kd, armature, coulomb = (np.array(x) for x in (servos.kp, servos.kd, servos.armature, servos.coulomb))
    q, qd, found = u[:, 0].copy(), np.zeros_like(u[:, 0]), []
    late, per = round(servos.delay / STEP), round((t[1] - t[0]) / STEP)
    own = INERTIA + MASS * COM**2
    for k in range(per * len(t)):
        if k % per == 0:
            found.append(q.copy())
        command = u[:, max(0, k - late) // per]
        c, s = np.cos(q[:, 1]), np.sin(q[:, 1])
        coupling = MASS[1] * LENGTH * COM[1]
        m22 = np.full(len(q), own[1])
        m12 = own[1] + coupling * c
        m11 = own.sum() + MASS[1] * LENGTH**2 + 2 * coupling * c
        sway = coupling * s
        both = np.sin(q[:, 0] + q[:, 1])
        weight = GRAVITY * np.stack(
            [
                (MASS[0] * COM[0] + MASS[1] * LENGTH) * np.sin(q[:, 0]) + MASS[1] * COM[1] * both,
                MASS[1] * COM[1] * both,
            ],
            axis=1,
        )
        turning = np.stack([-sway * (2 * qd[:, 0] * qd[:, 1] + qd[:, 1] ** 2), sway * qd[:, 0] ** 2], axis=1)
        mass = np.stack([np.stack([m11, m12], 1), np.stack([m12, m22], 1)], 1) + np.diag(armature)
        force = kp * (command - q) - kd * qd - weight - turning
        inverse = np.linalg.inv(mass + np.diag(STEP / 2 * kd))  # damping at a step's middle
        qd = qd + STEP * np.einsum("bij,bj->bi", inverse, force)
        impulse = np.zeros_like(qd)
        for _ in range(3):
            for joint in (0, 1):
                before = impulse[:, joint].copy()
                wanted = before - qd[:, joint] / inverse[:, joint, joint]
                impulse[:, joint] = np.clip(wanted, -STEP * coulomb[joint], STEP * coulomb[joint])
                qd = qd + inverse[:, :, joint] * (impulse[:, joint] - before)[:, None]
        q = q + STEP * qd
    return np.stack(found, axis=1)
