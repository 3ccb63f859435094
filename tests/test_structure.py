"""The derived structure of the project's robots is correct; the time to derive it grows slowly with joints."""

from fractions import Fraction

import numpy as np
import pytest
from arms import planar, random_arm

from spelgen.arm.arm import make_arm
from spelgen.arm.configured_arm import load_arm
from spelgen.structure.recursion import triangle
from spelgen.structure.sampling import float_samples
from spelgen.structure.structure import derive
from spelgen.urdf.read import read_urdf

COUNTS = {  # per robot: numbers of network outputs, constants, and zero entries of M
    "two_link": (1, 2, 0),
    "rpr": (3, 2, 1),
    "scara": (3, 4, 3),
    "six_dof": (18, 3, 0),
    "panda": (27, 1, 0),
    "ur10e": (18, 3, 0),
}


@pytest.mark.parametrize("robot", COUNTS)
def test_counts_of_the_own_robots(robots, robot):
    structure = derive(load_arm(robots / f"{robot}.urdf").chain)
    zeros = sum(entry.kind == "zero" for entry in structure.entries)
    assert (len(structure.outputs), len(structure.constants), zeros) == COUNTS[robot]
    assert not structure.passive
    assert all(0 not in output.joints for output in structure.outputs), "no output reads joint 1"


def test_rpr_has_the_structure_of_the_paper(robots):
    structure = derive(load_arm(robots / "rpr.urdf").chain)
    assert sorted(output.joints for output in structure.outputs) == [(1, 2), (1, 2), (2,)]
    assert {(e.row, e.column): e.kind for e in structure.entries if e.kind != "varying"} == {
        (1, 1): "constant",
        (2, 1): "zero",
        (2, 2): "constant",
    }
    assert structure.potential == (2,)


def test_a_planar_chain_separates_shared_functions():
    """The outputs (functions f_j of q in M) of a planar 3R arm are functions of q2, q3 and q2 + q3, one of each.

    The entry M_11 contains only a sum of all three; they are separated with the help of the other entries of M.
    """
    structure = derive(planar(3))
    assert [output.joints for output in structure.outputs] == [(2,), (1,), (1, 2)]
    assert len(structure.constants) == 3


@pytest.mark.parametrize("robot", COUNTS)
def test_smallest_form_is_exact(robots, robot):
    """M(q) = sum_j f_j(q) B_j + sum_k c_k A_k for outputs f_j, constants c_k, and matrices B_j, A_k of the structure.

    The values of f_j and c_k are computed from M: as the weighted sums of its entries that the structure states.
    """
    loaded = load_arm(robots / f"{robot}.urdf")
    structure = derive(loaded.chain)
    keys = triangle(len(structure.joints))
    mass = float_samples(loaded.chain, "kinematics", 50, seed=9)[0]
    rebuilt = np.zeros_like(mass)
    for term in (*structure.outputs, *structure.constants):
        value = sum(float(weight) * mass[:, keys.index((i, j))] for i, j, weight in term.functional)
        for i, j, factor in term.basis:
            rebuilt[:, keys.index((i, j))] += float(factor) * value
    assert np.abs(rebuilt - mass).max() < 1e-10 * np.abs(mass).max()


def test_factors_are_exact_fractions(robots):
    """Factors of the outputs in M are exact fractions: two_link has M_11 = 2 f(q) + constant, M_21 = f(q) + constant.

    The factor 2 is in eq. 20 of Wang, Chen and Ding, Sci Rep 15:33179, 2025.
    """
    structure = derive(load_arm(robots / "two_link.urdf").chain)
    assert structure.outputs[0].basis == ((0, 0, Fraction(2)), (1, 0, Fraction(1)))


@pytest.mark.parametrize(("joints", "seed"), [(6, 0), (7, 1), (8, 2), (10, 3)])
def test_generic_arms_follow_the_formula(joints, seed):
    """M of an arm with n joints and random geometry has n(n+1)/2 - 1 varying terms (outputs) and one constant term.

    All entries of the lower triangle vary independently, except M_nn, which is constant.
    """
    structure = derive(random_arm(joints, seed))
    assert (len(structure.outputs), len(structure.constants)) == (joints * (joints + 1) // 2 - 1, 1)
    # Khalil and Dombre, Modeling, Identification and Control of Robots, 2002, section 9.4: 7 n - 4 base parameters if
    # axis 1 is not along gravity
    assert structure.base_parameter_count == 7 * joints - 4


def test_edo_by_singular_values(shared):
    """Eleven of edo's outputs (functions f_j of q in M) depend on joints 1-3: the changes of M with them have rank 11.

    The reference data (../shared/arms) count ten: the eleventh singular value of sampled changes of M is only 1e-10 of
    the first, below the tolerance of the reference data.
    """
    joints = [f"joint_{k}" for k in range(1, 7)]
    arm = make_arm(read_urdf(shared / "arms" / "edo.urdf"), joints=joints)
    structure = derive(arm)
    assert (len(structure.outputs), structure.outputs_from(3)) == (20, 9)
    samples = float_samples(arm, "kinematics", 400)
    changes = np.concatenate([samples[k + 1] - samples[0] for k in range(3)])
    sizes = np.linalg.svd(changes, compute_uv=False)
    sizes /= sizes[0]
    assert sizes[9] > 1e-2
    # The eleventh singular value of the changes of M is far above rounding errors, so the exact rank is 11. It is just
    # below the tolerance of the reference data, which therefore count ten.
    assert 1e-11 < sizes[10] < 1e-9
    assert sizes[11] < 1e-15
