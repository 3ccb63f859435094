"""Rendering of templates as text. Templates contain the layout only; all content is computed in Python.

Every HTML page has the same style sheet and scripts, and a policy that forbids all other scripts and all downloads.
"""

import base64
import hashlib
import json
from functools import cache
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from spelgen.version import __version__

# An installed package contains the folder of templates; in the repository the folder is next to the package.
_INSTALLED = Path(__file__).parent / "templates"
_FOLDER = _INSTALLED if _INSTALLED.is_dir() else Path(__file__).parents[1] / "templates"


@cache
def _environment(autoescape: bool) -> Environment:
    return Environment(
        loader=FileSystemLoader(_FOLDER),
        # A misspelt name in a template raises an error; by default it would be an empty text in a page or in generated
        # code.
        undefined=StrictUndefined,
        autoescape=autoescape,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def render(template: str, **context: object) -> str:
    """Return the text of the Jinja template ``template``, with the values of ``context`` in place of their names.

    A name that is not in ``context`` raises an error. In HTML templates, special characters of the values are escaped.
    """
    return _environment(".html" in template).get_template(template).render(**context)


def read(name: str) -> str:
    """Return the unchanged text of a file in the folder of templates, such as a style sheet or a script."""
    return (_FOLDER / name).read_text(encoding="utf-8")


SCRIPTS = ("page.js", "arm.js")


def render_page(template: str, **context: object) -> str:
    """Return one self-contained HTML page from a template.

    The Content-Security-Policy of the page admits its own style sheet and scripts by their digests and nothing else:
    the page loads no file or address, and text from a user's file cannot run as a script.
    """
    # Style sheet and scripts are inline in a page, so that a page is a single file, which can be sent by mail.
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
    """Return `data` as JSON for a <script> element; characters that could end the element are escaped."""
    # NaN is not valid JSON. It raises an error here; otherwise the script would fail in the browser.
    text = json.dumps(data, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return Markup(text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e"))


@cache
def _assets() -> tuple[Markup, ...]:
    return tuple(Markup(read(name).strip()) for name in ("page.css", *SCRIPTS))


def _digest(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"
