"""Whether a module is up to date with its URDF: the function ``check``."""

from dataclasses import dataclass, replace
from pathlib import Path

from spelgen.certificate.verify import Verification, verify
from spelgen.emission.plan import derive_spec
from spelgen.emission.specify import arm_of_spec, find_urdf
from spelgen.emission.text import module_text, parse_spec, read_source
from spelgen.structure.structure import derive


@dataclass(frozen=True)
class CheckResult:
    """Whether a module is up to date with its URDF; ``reasons`` state the differences."""

    urdf: Path
    fresh: bool
    reasons: tuple[str, ...]
    proof: Verification


def check(module: str | Path, urdf: str | Path | None = None) -> CheckResult:
    """Derive the module at ``module`` again with its own options, compare it, and verify its structure numerically.

    Without ``urdf``, the URDF is searched by its name in the folder of the module, the current folder and
    ``robots/``. Raises ModuleError if there is none, or if the file is no module.
    """
    module = Path(module)
    text = read_source(module)
    stated = parse_spec(text, module)
    path = Path(urdf) if urdf is not None else find_urdf(module, stated.urdf)
    arm = arm_of_spec(stated, path)
    # the path of the URDF may differ from the one at the time of the build; its digest is compared
    spec = replace(derive_spec(arm, stated.options), urdf=stated.urdf)
    reasons = []
    if spec.urdf_sha256 != stated.urdf_sha256:
        reasons.append(f"{path} has changed since the module was built")
    if spec.sha256 != stated.sha256:
        reasons.append("the derived model differs from the one in the module")
    # a module is built again in both forms, because its text does not state its form
    if text not in (module_text(spec, standalone=is_standalone) for is_standalone in (False, True)):
        reasons.append("the text of the module differs from that of `spelgen build`")
    # independently of the comparison: an error of the derivation would be in both texts
    proof = verify(arm.robot, arm.chain, derive(arm.chain, stated.options.assume))
    reasons += [str(difference) for difference in proof.differences]
    return CheckResult(path, not reasons, tuple(reasons), proof)
