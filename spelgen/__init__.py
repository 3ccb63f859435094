"""spelgen: a URDF in, a PyTorch model of the arm's dynamics with its exact structure out."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from spelgen.version import __version__

if TYPE_CHECKING:
    from spelgen.arm.configured_arm import ConfiguredArm, load_arm
    from spelgen.certificate.inspection import Inspection, inspect
    from spelgen.certificate.module_check import check
    from spelgen.design import Design
    from spelgen.dynamics.linear_friction import FrictionModel
    from spelgen.dynamics.tip import tip_kinematics
    from spelgen.emission.build import build
    from spelgen.emission.loading import load_module
    from spelgen.emission.specify import generate
    from spelgen.errors import SpelgenError
    from spelgen.evaluation.evaluate import evaluate
    from spelgen.evaluation.results import Results
    from spelgen.evaluation.rollout import rollout
    from spelgen.excitation.design import excite
    from spelgen.exporting.export import export
    from spelgen.fitting.fit import Fit, RunOptions, fit, load_run
    from spelgen.identification.identification import Identification, LeastSquares
    from spelgen.identification.identify import identify
    from spelgen.log_checks.check_logs import check_logs
    from spelgen.logs.preprocessing import Preprocessing
    from spelgen.logs.read import read_logs, write_logs
    from spelgen.logs.trajectory import Trajectory
    from spelgen.settings.fits import GaussianPrior, MomentumFit, Rollout, TorqueFit
    from spelgen.simulation.as_built import as_built
    from spelgen.simulation.simulate import simulate


_HOME = {
    "load_arm": "arm.configured_arm",
    "ConfiguredArm": "arm.configured_arm",
    "inspect": "certificate.inspection",
    "Inspection": "certificate.inspection",
    "generate": "emission.specify",
    "Design": "design",
    "build": "emission.build",
    "load_module": "emission.loading",
    "check": "certificate.module_check",
    "read_logs": "logs.read",
    "write_logs": "logs.read",
    "Trajectory": "logs.trajectory",
    "check_logs": "log_checks.check_logs",
    "Preprocessing": "logs.preprocessing",
    "simulate": "simulation.simulate",
    "as_built": "simulation.as_built",
    "excite": "excitation.design",
    "identify": "identification.identify",
    "LeastSquares": "identification.identification",
    "FrictionModel": "dynamics.linear_friction",
    "Identification": "identification.identification",
    "fit": "fitting.fit",
    "Fit": "fitting.fitted",
    "RunOptions": "fitting.objective",
    "load_run": "fitting.fitted",
    "GaussianPrior": "settings.fits",
    "TorqueFit": "settings.fits",
    "MomentumFit": "settings.fits",
    "Rollout": "settings.fits",
    "rollout": "evaluation.rollout",
    "evaluate": "evaluation.evaluate",
    "Results": "evaluation.results",
    "tip_kinematics": "dynamics.tip",
    "export": "exporting.export",
    "SpelgenError": "errors",
}
"""The file that each name of the API lives in; loaded on first use (PEP 562), so `import spelgen` stays fast."""

__all__ = [
    "ConfiguredArm",
    "Design",
    "Fit",
    "FrictionModel",
    "GaussianPrior",
    "Identification",
    "Inspection",
    "LeastSquares",
    "MomentumFit",
    "Preprocessing",
    "Results",
    "Rollout",
    "RunOptions",
    "SpelgenError",
    "TorqueFit",
    "Trajectory",
    "__version__",
    "as_built",
    "build",
    "check",
    "check_logs",
    "evaluate",
    "excite",
    "export",
    "fit",
    "generate",
    "identify",
    "inspect",
    "load_arm",
    "load_module",
    "load_run",
    "read_logs",
    "rollout",
    "simulate",
    "tip_kinematics",
    "write_logs",
]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(f"spelgen.{_HOME[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
