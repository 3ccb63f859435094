"""What every page has: its style, its scripts, and a policy that lets it run these and load nothing."""

from __future__ import annotations

import base64
import hashlib
import json
from functools import cache

from markupsafe import Markup

from spelgen.templates import read, render
from spelgen.version import __version__

SCRIPTS = ("page.js", "arm.js")


def render_page(template: str, **context: object) -> str:
    """Return one self-contained page.

    Its Content-Security-Policy admits the style and the scripts in it by their digests, and nothing else: no file or
    address can be loaded, and no text that came through can run.
    """
    style, *scripts = _assets()
    return render(
        template,
        version=__version__,
        style=style,
        style_hash=Markup(_digest(style)),
        scripts=scripts,
        script_hashes=Markup(" ").join(Markup("'{}'").format(_digest(script)) for script in scripts),
        **context,
    )


def json_data(data: object) -> Markup:
    """JSON that may stand in a <script> element: none of its text can end the element."""
    # NaN is no JSON: better an error here than a page whose script stops
    text = json.dumps(data, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return Markup(text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e"))


@cache
def _assets() -> tuple[Markup, ...]:
    return tuple(Markup(read(name).strip()) for name in ("page.css", *SCRIPTS))


def _digest(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"
