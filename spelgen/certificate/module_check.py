"""The function ``check``: test whether a module that spelgen has built is up to date with its URDF."""

from dataclasses import dataclass, replace
from pathlib import Path

from spelgen.certificate.verify import Verification, verify
from spelgen.emission.plan import derive_spec
from spelgen.emission.specify import arm_of_spec, find_urdf
from spelgen.emission.text import module_text, parse_spec, read_source
from spelgen.structure.structure import derive


@dataclass(frozen=True)
class CheckResult:
    """Result of ``check`` for a module.

    Attributes:
        urdf: path of the URDF.
        fresh: True if the module is up to date and the numerical verification of the structure finds no error.
        reasons: differences between module and URDF, and errors of the structure, as text; empty if ``fresh``.
        proof: numerical verification of the structure.
    """

    urdf: Path
    fresh: bool
    reasons: tuple[str, ...]
    proof: Verification


def check(module: str | Path, urdf: str | Path | None = None) -> CheckResult:
    """Test whether a module is up to date with its URDF.

    The module is generated again with the options of its build and compared, and the structure is verified numerically.

    Raises ModuleError if the URDF is not found, or if the file is not a module of spelgen.

    Args:
        module: Path of the module.
        urdf: Path of the URDF; None: it is searched by its name in the folder of the module, the current folder and
            ``robots/``.
    """
    module = Path(module)
    text = read_source(module)
    stated = parse_spec(text, module)
    path = Path(urdf) if urdf is not None else find_urdf(module, stated.urdf)
    arm = arm_of_spec(stated, path)
    # The URDF is compared by its digest. A different path is no difference, since the file may have been moved since
    # the build: the newly derived `spec` gets the path that the module states.
    spec = replace(derive_spec(arm, stated.options), urdf=stated.urdf)
    reasons = []
    if spec.urdf_sha256 != stated.urdf_sha256:
        reasons.append(f"{path} has changed since the module was built")
    if spec.sha256 != stated.sha256:
        reasons.append("the derived model differs from the one in the module")
    # The text of the module is compared with both forms, standalone or not, because it does not state its form.
    if text not in (module_text(spec, standalone=is_standalone) for is_standalone in (False, True)):
        reasons.append("the text of the module differs from that of `spelgen build`")
    # The comparison of the module with its newly generated text cannot detect an error in the derivation of the
    # structure, since both texts would contain the same error. The verification by Pinocchio is independent of the
    # derivation.
    proof = verify(arm.robot, arm.chain, derive(arm.chain, stated.options.assume))
    reasons += [str(difference) for difference in proof.differences]
    return CheckResult(path, not reasons, tuple(reasons), proof)
