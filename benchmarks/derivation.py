"""Times of the derivation of M, V and G from geometry, compared with sympy's Lagrange equations.

The arms are the Panda from its URDF, and chains with random geometry. Times are medians of repeats in one run. Sympy
derives only the smallest arms, in the way of a user who derives equations by hand.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from arms import planar, random_arm

from spelgen.arm.configured_arm import load_arm
from spelgen.structure.structure import derive

ROBOTS = Path(__file__).parents[1] / "robots"


def median_seconds(work: Callable[[], object], repeats: int = 5) -> float:
    """Return the median processor time [s] of ``work``, after one call whose time does not count."""
    work()
    times = []
    for _ in range(repeats):
        derive.cache_clear()  # each repeat derives the structure again, which would otherwise be cached
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return statistics.median(times)


def lagrange(joints: int) -> None:
    """Derive and simplify the mass matrix of a planar chain by sympy.physics.mechanics, only to measure the time."""
    import sympy
    from sympy.physics import mechanics

    q = mechanics.dynamicsymbols(f"q1:{joints + 1}")
    frame, point = mechanics.ReferenceFrame("N"), mechanics.Point("O")
    point.set_vel(frame, 0)
    bodies, ground = [], frame
    for k in range(joints):
        mass, lever, inertia = sympy.symbols(f"m{k} r{k} I{k}", positive=True)
        frame = frame.orientnew(f"A{k}", "Axis", [q[k], frame.z])
        center = point.locatenew(f"C{k}", lever * frame.x)
        center.v2pt_theory(point, ground, frame)
        tensor = (mechanics.inertia(frame, 0, 0, inertia), center)
        bodies.append(mechanics.RigidBody(f"B{k}", center, frame, mass, tensor))
        end = point.locatenew(f"P{k}", sympy.Rational(1, 2) * frame.x)
        end.v2pt_theory(point, ground, frame)
        point = end
    method = mechanics.LagrangesMethod(mechanics.Lagrangian(ground, *bodies), q)
    method.form_lagranges_equations()
    sympy.simplify(method.mass_matrix)


def main() -> None:
    """Print the time of the derivation per arm; for planar chains also the time of sympy and the ratio of the two."""
    panda = ROBOTS / "panda.urdf"
    print(f"panda, URDF to structure      {median_seconds(lambda: derive(load_arm(panda).chain)):8.3f} s")
    for joints in (6, 7, 8, 10, 12):
        arm = random_arm(joints, 0)
        print(f"random geometry, {joints:>2} joints    {median_seconds(lambda arm=arm: derive(arm)):8.3f} s")
    for joints in (2, 3, 4):
        arm = planar(joints)
        ours = median_seconds(lambda arm=arm: derive(arm))
        theirs = median_seconds(lambda joints=joints: lagrange(joints), repeats=1)
        print(
            f"planar, {joints} joints              {ours:8.3f} s   sympy {theirs:8.2f} s   {theirs / ours:6.0f}x"
        )


if __name__ == "__main__":
    main()
