"""The five lines that lie beside every export."""

from __future__ import annotations

from collections.abc import Sequence

from spelgen.errors import RunError
from spelgen.labels import printable


def readme(title: str, use: str, joints: Sequence[str], conventions: str, checked: str) -> bytes:
    """Title, how it is used, the joints in their order, conventions, and what the check at export time found."""
    listed = ", ".join(printable(name) for name in joints)
    lines = [f"# {printable(title)}", use, f"Joints, in this order: {listed}.", conventions, checked]
    if any("\n" in line for line in lines):
        raise RunError("a line break", element="README")
    return ("\n".join(lines) + "\n").encode()


UNITS = "Units: rad and Nm for revolute joints, m and N for prismatic ones"
