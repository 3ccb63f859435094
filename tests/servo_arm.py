"""A two-link arm in a vertical plane under position servos, with a simulator of its own."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, exp, sin
from pathlib import Path

import numpy as np

from spelgen.logs.trajectory import Trajectory

LINK = """<link name="{name}"><inertial><origin xyz="0 0 -{com}"/><mass value="{mass}"/>
<inertia ixx="{inertia}" iyy="{inertia}" izz="1e-5" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/><axis xyz="0 1 0"/>
<origin xyz="0 0 {z}"/><limit lower="-3" upper="3" effort="6" velocity="5"/></joint>"""
LENGTH, COM, MASS, INERTIA = 0.2, np.array([0.1, 0.08]), np.array([0.3, 0.2]), np.array([1.2e-3, 6e-4])
GRAVITY, STEP, STRIBECK_VELOCITY = 9.81, 5e-4, 0.2


@dataclass(frozen=True)
class Servos:
    """True servos of both joints of the simulated arm.

    kp [Nm/rad], kd [Nm s/rad], armature [kg m^2], Coulomb friction [Nm]; stribeck [Nm]: additional friction at rest,
    which falls as exp(-qd^2 / STRIBECK_VELOCITY^2); dead_zone: half its width [rad]; delay of the commands [s].
    """

    kp: tuple[float, float] = (14.0, 9.0)
    kd: tuple[float, float] = (0.9, 0.5)
    armature: tuple[float, float] = (0.03, 0.012)
    coulomb: tuple[float, float] = (0.15, 0.08)
    stribeck: tuple[float, float] = (0.0, 0.0)
    dead_zone: tuple[float, float] = (0.0, 0.0)
    delay: float = 0.03


def write_servo_arm(folder: Path, settings: str = "input: position\n") -> Path:
    """Write the URDF of the two-link arm and its settings file; return the path of the URDF."""
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
    count: int,
    seconds: float,
    servos: Servos = Servos(),
    seed: int = 0,
    swing: float = 1.0,
    held: float | None = None,
) -> list[Trajectory]:
    """Simulate ``count`` logs of ``seconds`` each at 50 Hz, with encoders of 4096 steps per revolution.

    The commands are sums of sines about levels that jump every 2 s. swing: factor of the sines; 0: only levels.
    servos: true parameters of the servos. held: constant command of the elbow [rad]; None: it moves like the shoulder.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 0.02)
    u = np.stack([_commands(rng, t, swing) for _ in range(count)])
    if held is not None:
        u[:, :, 1] = held
    q = np.stack([_simulated(t, each, servos) for each in u])
    q = np.round(q * 4096 / (2 * np.pi)) * (2 * np.pi / 4096)
    nothing = np.zeros((len(t), 0))
    return [
        Trajectory(t, x, np.gradient(x, t, axis=0), nothing, name=f"motion {k}", u=u[k])
        for k, x in enumerate(q)
    ]


def _commands(rng: np.random.Generator, t: np.ndarray, swing: float) -> np.ndarray:
    """Return random commands at times t (T,) [s], (T, 2) [rad]: sums of sines about levels that jump every 2 s.

    swing: factor of the sums; for 1, each is a sum of three sines with amplitudes of 0.05 to 0.3 rad.
    """
    waves = sum(
        rng.uniform(0.05, 0.3)
        * np.sin(2 * np.pi * rng.uniform(0.05, 1.2, 2) * t[:, None] + rng.uniform(0, 6, 2))
        for _ in range(3)
    )
    levels = rng.uniform(-0.5, 0.5, (int(t[-1] / 2) + 1, 2))[(t / 2).astype(int)]
    return np.asarray(swing * waves + levels)


def _simulated(t: np.ndarray, u: np.ndarray, servos: Servos) -> np.ndarray:
    """Return the positions (T, 2) [rad] of the arm under commands u (T, 2) [rad], from rest at the first command.

    Semi-implicit Euler, with dry friction as the impulse that stops a joint, limited to the friction torque. All
    numbers are scalars: for two joints that is faster than arrays.
    """
    (kp1, kp2), (kd1, kd2) = servos.kp, servos.kd
    (dry1, dry2), (slow1, slow2), (zone1, zone2) = servos.coulomb, servos.stribeck, servos.dead_zone
    own1, own2 = (INERTIA + MASS * COM**2).tolist()
    coupling = float(MASS[1] * LENGTH * COM[1])
    base1, base2 = own1 + own2 + float(MASS[1]) * LENGTH**2 + servos.armature[0], own2 + servos.armature[1]
    weight1, weight2 = GRAVITY * float(MASS[0] * COM[0] + MASS[1] * LENGTH), GRAVITY * float(MASS[1] * COM[1])
    (q1, q2), v1, v2, found = u[0].tolist(), 0.0, 0.0, []
    late, per, commands = round(servos.delay / STEP), round((t[1] - t[0]) / STEP), u.tolist()
    for k in range(per * len(t)):
        if k % per == 0:
            found.append((q1, q2))
        u1, u2 = commands[max(0, k - late) // per]
        c, sway = coupling * cos(q2), coupling * sin(q2)
        both = weight2 * sin(q1 + q2)
        wrong1, wrong2 = u1 - q1, u2 - q2
        wrong1 -= min(max(wrong1, -zone1), zone1)
        wrong2 -= min(max(wrong2, -zone2), zone2)
        most1 = STEP * (dry1 + slow1 * exp(-((v1 / STRIBECK_VELOCITY) ** 2)))
        most2 = STEP * (dry2 + slow2 * exp(-((v2 / STRIBECK_VELOCITY) ** 2)))
        force1 = kp1 * wrong1 - kd1 * v1 - weight1 * sin(q1) - both + sway * (2 * v1 * v2 + v2 * v2)
        force2 = kp2 * wrong2 - kd2 * v2 - both - sway * v1 * v1
        # damping acts on the mean of old and new velocity: the half of the new velocity, STEP / 2 * kd, is added to M
        m11, m12, m22 = base1 + 2 * c + STEP / 2 * kd1, own2 + c, base2 + STEP / 2 * kd2
        determinant = m11 * m22 - m12 * m12
        i11, i12, i22 = m22 / determinant, -m12 / determinant, m11 / determinant
        v1, v2 = v1 + STEP * (i11 * force1 + i12 * force2), v2 + STEP * (i12 * force1 + i22 * force2)
        impulse1 = impulse2 = 0.0
        for _ in range(3):
            before, impulse1 = impulse1, min(max(impulse1 - v1 / i11, -most1), most1)
            v1, v2 = v1 + i11 * (impulse1 - before), v2 + i12 * (impulse1 - before)
            before, impulse2 = impulse2, min(max(impulse2 - v2 / i22, -most2), most2)
            v1, v2 = v1 + i12 * (impulse2 - before), v2 + i22 * (impulse2 - before)
        q1, q2 = q1 + STEP * v1, q2 + STEP * v2
    return np.array(found)
