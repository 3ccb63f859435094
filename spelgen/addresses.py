"""Files at addresses that fsspec knows, `s3://bucket/logs` say: copied here to be read, and sent there once written.

All else in spelgen works on local paths. What is fetched lies in a temporary folder for as long as the process lives.
"""

from __future__ import annotations

import atexit
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from spelgen.errors import SpelgenError

# `Path` makes one slash of two; a Windows drive is one letter
ADDRESS = re.compile(r"^([a-z][a-z0-9+.-]+):/+(?=[^/])")

_copies: dict[str, Path] = {}  # address -> its local copy


def local(path: Path | str) -> Path:
    """A local path as it is; of an address the copy of what lies there, a file or a folder: what is written to it, and
    into it, is sent to the address (see `sent`). Raises SpelgenError where the address cannot be reached.
    """
    match = ADDRESS.match(str(path))
    if match is None or Path(path).exists():
        return Path(path)
    if match[1] == "file":  # whose slashes `Path` has taken, too
        return Path("/" + str(path)[match.end() :])
    address = f"{match[1]}://{str(path)[match.end() :]}".rstrip("/")
    if address not in _copies:
        _copies[address] = _fetched(address)
    return _copies[address]


def sent(path: Path) -> None:
    """Send a file that was written, or tell of one that was removed, to the address that it is of, if it is of one."""
    target = address_of(path)
    if target is None:
        return
    with reached(target) as (system, place):
        if path.exists():
            system.makedirs(system._parent(place), exist_ok=True)
            system.put_file(str(path), place)
        elif system.exists(place):
            system.rm_file(place)


def address_of(path: Path) -> str | None:
    """The address of which a path is the copy, or stands in it; None: it is a local one."""
    for address, copy in _copies.items():
        if path == copy or copy in path.parents:
            return address if path == copy else f"{address}/{path.relative_to(copy).as_posix()}"
    return None


def with_addresses(text: str) -> str:
    """What is said of local copies, said of their addresses."""
    for address, copy in _copies.items():
        text = text.replace(str(copy), address)
    return text


@contextmanager
def reached(address: str) -> Iterator[tuple[Any, str]]:
    """The file system of an address, and the path there. Within it, whatever the file system raises names the address:
    each has kinds of its own.
    """
    try:
        import fsspec

        yield fsspec.core.url_to_fs(address)
    except SpelgenError:
        raise
    except ImportError as error:
        raise SpelgenError(
            f"an address that needs a package ({error})", file=address, do="install it"
        ) from error
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise SpelgenError(f"cannot be reached ({reason})", file=address) from error


def _fetched(address: str) -> Path:
    folder = Path(tempfile.mkdtemp(prefix="spelgen-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    copy = folder / address.rsplit("/", 1)[-1]
    with reached(address) as (system, place):
        if system.isdir(place):
            copy.mkdir()
            for each in system.find(place):
                target = copy / each[len(place.rstrip("/")) :].lstrip("/")
                target.parent.mkdir(parents=True, exist_ok=True)
                system.get_file(each, str(target))
        elif system.exists(place):
            system.get_file(place, str(copy))
    return copy
