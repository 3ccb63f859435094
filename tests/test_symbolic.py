"""Exact polynomials of M(q) and of the potential energy V(q) confirm the structure that spelgen derives for an arm."""

import numpy as np
import pytest
from arms import planar, random_arm
from flint import fmpq_mat
from polynomials import Polynomials, polynomials

from spelgen.arm.configured_arm import load_arm
from spelgen.structure.recursion import triangle
from spelgen.structure.structure import derive

ROBOTS = ["two_link", "rpr", "scara", "six_dof", "ur10e", "panda"]


@pytest.mark.parametrize("robot", ROBOTS)
def test_spans_of_coefficients_agree_with_the_structure(robots, robot):
    """The derived structure agrees with exact polynomials of M(q) and of the potential energy V(q).

    M = sum_j f_j(q) B_j + sum_k c_k A_k has as many functions f_j (outputs) and constants c_k as the rank of the
    polynomials' coefficients. The zero entries of M, and the joints that each entry, each f_j and V depend on, agree.
    """
    arm = load_arm(robots / f"{robot}.urdf").chain
    _assert_agrees(derive(arm), polynomials(arm), len(arm.coordinates))


@pytest.mark.parametrize("arm", [planar(4), random_arm(4, 5)], ids=["planar", "generic"])
def test_spans_of_made_up_arms(arm):
    _assert_agrees(derive(arm), polynomials(arm), len(arm.coordinates))


def _assert_agrees(structure, poly: Polynomials, n: int) -> None:
    vectors = _coefficient_vectors(poly, n)
    everything = [v for v in vectors.values()]
    assert len(structure.outputs) + len(structure.constants) == _rank(everything)
    assert len(structure.outputs) == _rank([v for joints, v in vectors.items() if joints[0]])
    for first in range(n):
        touching = _rank([v for joints, v in vectors.items() if any(k < first for k in joints[0])])
        assert structure.outputs_from(first) == len(structure.outputs) - touching
    for index, entry in enumerate(structure.entries):
        joints = {k for (read, _), v in vectors.items() if index in v for k in read}
        assert tuple(sorted(joints)) == entry.joints
        assert (entry.kind == "zero") == (len(poly.mass[entry.row, entry.column]) == 0)
    for output in structure.outputs:
        assert _joints_of(poly.combination(output.functional), n) == set(output.joints)
    for constant in structure.constants:
        assert not _joints_of(poly.combination(constant.functional), n)
    assert _joints_of(poly.potential, n) == set(structure.potential)


def _coefficient_vectors(poly: Polynomials, n: int) -> dict:
    """Return the coefficients of all monomials of M: {(joints, exponents): {index of an entry of M: coefficient}}.

    exponents: of all variables of `poly`. joints: tuple of the coordinates, 0..n-1, whose cosine, sine or distance is
    in the monomial. index: of the entry in the lower triangle of M, row after row.
    """
    vectors: dict = {}
    for index, key in enumerate(triangle(n)):
        for exponents, coefficient in poly.mass[key].terms():
            joints = tuple(k for k in range(n) if any(exponents[3 * k : 3 * k + 3]))
            vectors.setdefault((joints, tuple(exponents)), {})[index] = coefficient
    return vectors


def _rank(vectors: list[dict]) -> int:
    # many monomials have equal coefficient vectors; repeated vectors do not change the rank and are omitted
    distinct = {tuple(sorted((index, str(value)) for index, value in v.items())): v for v in vectors}
    if not distinct:
        return 0
    width = 1 + max(index for v in distinct.values() for index in v)
    return fmpq_mat([[v.get(index, 0) for index in range(width)] for v in distinct.values()]).rank()


def _joints_of(polynomial, n: int) -> set[int]:
    return {k for exponents, _ in polynomial.terms() for k in range(n) if any(exponents[3 * k : 3 * k + 3])}


def test_two_link_is_the_papers_equation_20(robots):
    """M of two_link is [[7/2 + 2 f, 5/4 + f], [5/4 + f, 5/4]] with f = cos(q2) / 2, as derived by hand.

    M has the form of eq. 20 of Wang, Chen and Ding, Sci Rep 15:33179, 2025. Each link is 1 m long and has 1 kg and
    1 kg m^2 at its centre of mass in the middle.
    """
    true = polynomials(load_arm(robots / "two_link.urdf").chain, inertials=True)
    assert {key: str(value) for key, value in true.mass.items()} == {
        (0, 0): "c2 + 7/2",
        (1, 0): "1/2*c2 + 5/4",
        (1, 1): "5/4",
    }


def test_every_sine_is_reduced_under_mimic_joints(shared):
    """Polynomials have sines to the first power only, even if a mimic joint makes two bodies turn by one angle."""
    arm = load_arm(shared / "arms" / "abb_irb5400.urdf").chain
    poly = polynomials(arm)
    sines = [3 * k + 1 for k in range(len(arm.coordinates))]
    degrees = np.array([value.degrees() for value in (*poly.mass.values(), poly.potential)])
    assert degrees[:, sines].max() == 1
    structure = derive(arm)
    for entry in structure.entries:
        assert _joints_of(poly.mass[entry.row, entry.column], len(arm.coordinates)) == set(entry.joints)
