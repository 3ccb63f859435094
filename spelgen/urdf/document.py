"""Parse the bytes of a URDF file to an XML tree; unsafe content and other formats are errors."""

import re
from pathlib import Path
from typing import NamedTuple

from lxml import etree

from spelgen.errors import UrdfError, collect
from spelgen.files import read_bytes

MAX_BYTES = 20_000_000
_CONFLICT = re.compile(rb"^(?:<{7} |={7}\r?$|>{7} )", re.MULTILINE)
_UNBOUND = re.compile(r"Namespace prefix (\S+) (?:for \S+ )?on (\S+) is not defined")
_OTHER_FORMATS = {
    "mujoco": (
        "an MJCF file, which is out of scope",
        "take the URDF that its robot's maker publishes, or convert it, for example with the package "
        "mjcf-urdf-simple-converter",
    ),
    "sdf": ("an SDF file", "convert it to URDF first"),
    "COLLADA": ("a COLLADA mesh", "name the URDF that uses it"),
    "html": ("a web page", "download the file itself: 'Raw' on the page of a repository"),
}
# Common files that are no XML: {first bytes of the file in lower case: (kind of file, advice to the user)}
_NOT_XML = {
    b"version https://git-lfs": ("a pointer of Git LFS", "run 'git lfs pull' first"),
    b"<!doctype html": _OTHER_FORMATS["html"],
    b"pk\3\4": ("a ZIP archive", "unpack it, and name the URDF in it"),
    b"\x1f\x8b": ("a gzip archive", "unpack it, and name the URDF in it"),
}


class UrdfDocument(NamedTuple):
    """The bytes of a URDF file (``data``) and its ``<robot>`` element (``root``).

    ``path`` is the name of the file in errors. ``leftovers`` are the line numbers of ``<xacro:property>`` elements,
    which have no effect. For a xacro file, bytes and lines refer to the expanded document, and ``warnings`` are the
    warnings of xacro.
    """

    path: Path
    data: bytes
    root: etree._Element
    leftovers: tuple[int, ...]
    warnings: tuple[str, ...]


def urdf_bytes(path: Path) -> bytes:
    """Return the bytes of a URDF file, or of the URDF that a ``*.xacro`` file expands to. Raises UrdfError."""
    return _expanded(path)[0]


def read_document(path: Path) -> UrdfDocument:
    """Return the XML document of a URDF or xacro file. XML entities are not expanded, and parsing opens no other file.

    A ``*.xacro`` file is a program. It is executed before parsing and may open other files (see ``xacro_input``).

    Raises UrdfError for a missing or oversized file, a document type declaration, malformed XML, a root element other
    than ``<robot>``, and xacro that is not expanded.
    """
    data, warnings = _expanded(path)
    if is_xacro(path):
        path = path.with_name(f"{path.name} (expanded)")
        _refuse_damage(path, data)
    # huge_tree=False keeps the limits of libxml2 on the depth of elements (256) and on the length of texts.
    parser = etree.XMLParser(resolve_entities=False, no_network=True, huge_tree=False, load_dtd=False)
    try:
        root = etree.fromstring(data, parser)
    except etree.XMLSyntaxError as error:
        raise _syntax_error(path, error) from None
    except ValueError as error:
        raise UrdfError(f"not readable as XML ({error})", file=path, do="save the file as UTF-8") from None
    if root.getroottree().docinfo.internalDTD is not None:
        raise _doctype_error(path, None)
    _check_root(path, root)
    return UrdfDocument(path, data, root, _check_xacro(path, root), warnings)


def is_xacro(path: Path) -> bool:
    """Whether the name of a file marks it as a xacro file."""
    return path.suffix.lower() == ".xacro"


def _expanded(path: Path) -> tuple[bytes, tuple[str, ...]]:
    """Return the bytes of a URDF file, or of the URDF that a ``*.xacro`` file expands to, and the warnings of xacro."""
    data = read_bytes(path, UrdfError, "a URDF file", MAX_BYTES, "keep meshes in files of their own")
    _refuse_damage(path, data)
    if not is_xacro(path):
        return data, ()
    from spelgen.urdf.xacro_input import expand

    return expand(path, MAX_BYTES)


def _line_of(data: bytes, position: int) -> int:
    return data.count(b"\n", 0, position) + 1


def _refuse_damage(path: Path, data: bytes) -> None:
    """Raise UrdfError for unsafe declarations, and for malformed content that the XML parser would not name clearly.

    Such content is an empty file, conflict markers of git, or text before the XML declaration.
    """
    if not data.strip():
        raise UrdfError("an empty file", file=path, expected="a URDF document")
    for first, (got, do) in _NOT_XML.items():
        if data[:100].lstrip().lower().startswith(first):
            raise UrdfError(got, file=path, expected="a URDF document", do=do)
    # Conflict markers of git are the most common defect, and the message of the parser would not name them.
    conflict = _CONFLICT.search(data)
    if conflict:
        line, do = _line_of(data, conflict.start()), "resolve the merge conflict first"
        raise UrdfError("a merge-conflict marker", file=path, line=line, expected="XML", do=do)
    text = data.removeprefix(b"\xef\xbb\xbf")  # UTF-8 byte order mark
    if text.lstrip().startswith(b"<?xml") and not text.startswith(b"<?xml"):
        raise UrdfError(
            "text or blank lines before the XML declaration", file=path, line=_line_of(data, data.index(b"<?xml")),
            expected="<?xml ...?> at the very start of the file", do="delete the text before it",
        )  # fmt: skip
    # DOCTYPE and ENTITY declarations are refused before parsing: an entity could expand to gigabytes, or read another
    # file.
    for declaration in (b"<!DOCTYPE", b"<!ENTITY"):
        if declaration in data:
            raise _doctype_error(path, _line_of(data, data.index(declaration)))


def _doctype_error(path: Path, line: int | None) -> UrdfError:
    got, do = "a document type or entity declaration", "remove it: entities are never expanded"
    return UrdfError(got, file=path, line=line, expected="plain XML", do=do)


def _syntax_error(path: Path, error: etree.XMLSyntaxError) -> UrdfError:
    message = error.msg or "unknown error"
    unbound = _UNBOUND.search(message)
    if unbound:
        prefix, tag = unbound.groups()
        return UrdfError(
            f"the prefix {prefix!r}, which nothing declares", file=path, line=error.lineno,
            element=f"<{prefix}:{tag}>", expected="well-formed XML",
            do=f'add xmlns:{prefix}="..." to <robot>, or remove the prefix',
        )  # fmt: skip
    reason = " ".join(re.sub(r",? ?line \d+, column \d+.*", "", message).split())
    do = "save the file as UTF-8, or declare its encoding in <?xml ...?>" if "encoding" in reason else None
    if reason.startswith(("Start tag expected", "Document is empty")):
        do = "name the URDF: this is a file of another kind"
    return UrdfError(f"not well-formed XML ({reason})", file=path, line=error.lineno, do=do)


def _check_root(path: Path, root: etree._Element) -> None:
    name = etree.QName(root)
    got, expected, do = f"the root element <{name.localname}>", "<robot>", "convert it to URDF first"
    if name.localname == "robot":
        if not name.namespace:
            return
        got, expected = f"<robot> in the namespace {name.namespace!r}", "<robot> in no namespace"
        do = f'remove xmlns="{name.namespace}"'
    elif name.localname in _OTHER_FORMATS:
        description, do = _OTHER_FORMATS[name.localname]
        got += f" of {description}"
    raise UrdfError(got, file=path, line=root.sourceline, expected=expected, do=do)


def _check_xacro(path: Path, root: etree._Element) -> tuple[int, ...]:
    """Return the line numbers of <xacro:property> elements, which may remain after expansion and have no effect.

    Raises UrdfError if there are other xacro elements, since the document is then not expanded. References to a
    property, such as ``${mass}``, are not found here: they are errors when the number is read.
    """
    errors, leftovers = [], []
    for element in root.iter(etree.Element):
        name, line = etree.QName(element), element.sourceline
        if not (name.namespace and name.namespace.endswith("/xacro")):
            continue
        if name.localname == "property":
            leftovers.append(line)
            continue
        where, do = f"<{element.prefix}:{name.localname}>", "expand the file with the xacro command first"
        got = "xacro that was not expanded"
        errors.append(UrdfError(got, file=path, line=line, element=where, expected="plain URDF", do=do))
    collect(errors)
    return tuple(leftovers)
