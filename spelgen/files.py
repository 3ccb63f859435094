"""Read regular files alone, write files so that each is either complete or not there, and copy what lies at addresses.

Addresses are those that fsspec knows, such as `s3://bucket/logs`. All else in spelgen works on local paths: a copy lies
in a temporary folder for as long as the process lives, and what is written to it is sent to the address.
"""

from __future__ import annotations

import atexit
import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from spelgen.errors import SpelgenError

LARGEST_TEXT = 2**25  # bytes: parsed JSON or Python takes some thirty times as much memory


def require_regular_file(path: Path, error: type[SpelgenError], expected: str | None = None) -> None:
    """Raise ``error`` unless a path is a regular file: whoever opens a pipe or a device may wait for ever."""
    if not path.is_file():
        raise error("no regular file", file=path, expected=expected)


def read_bytes(
    path: Path,
    error: type[SpelgenError],
    kind: str | None = None,
    largest: int = LARGEST_TEXT,
    do: str | None = None,
) -> bytes:
    """Return what a regular file of at most so many bytes holds.

    Raises ``error``. kind: what is expected there. do: what to do where the file is too large.
    """
    try:
        size = path.stat().st_size  # FileNotFoundError before all else
        require_regular_file(path, error, kind)
        if size <= largest:
            return path.read_bytes()
    except FileNotFoundError:
        raise error("no such file", file=path) from None
    except (OSError, ValueError) as problem:  # ValueError: a null character in the name
        reason = getattr(problem, "strerror", None) or str(problem)
        raise error(f"cannot be read ({reason})", file=path) from None
    raise error(f"a file of {size} bytes", file=path, expected=f"at most {largest}", do=do)


def read_json(path: Path, error: type[SpelgenError]) -> dict[str, Any]:
    """Return the object in a JSON file. Raises ``error`` where it is absent, broken or another value."""
    try:
        content = json.loads(read_bytes(path, error))
    except (ValueError, RecursionError) as problem:
        raise error(f"broken JSON ({problem})", file=path) from problem
    if not isinstance(content, dict):
        raise error(f"{type(content).__name__} in JSON", file=path, expected="an object")
    return content


@contextmanager
def limited_memory(size: int) -> Iterator[None]:
    """Let the process take at most so many bytes more: what unpacks to no end then raises MemoryError.

    For readers of others that believe what a file says of its size; without effect where the system is not Linux.
    """
    try:
        import resource

        pages = int(Path("/proc/self/statm").read_text().split()[0])
    except (ImportError, OSError):
        yield
        return
    before, largest = resource.getrlimit(resource.RLIMIT_AS)
    allowed = pages * resource.getpagesize() + size
    if largest != resource.RLIM_INFINITY:
        allowed = min(allowed, largest)
    resource.setrlimit(resource.RLIMIT_AS, (allowed, largest))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (before, largest))


@contextmanager
def replacing(path: Path | str) -> Iterator[Path]:
    """Yield a hidden neighbour to write to, which in the end takes the place of `path`, also through a power cut.

    Makes the folder, and sends the file to its address if it has one. An interrupted or failed write leaves what was
    there before. Raises OSError naming the path when it cannot be written: a full disk, say.
    """
    path = Path(path)
    with naming(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        try:
            yield unfinished
            # without it the new name may stand before the new content does, when power is cut
            with unfinished.open("rb+") as file:
                os.fsync(file.fileno())
            os.replace(unfinished, path)
            sent(path)
        finally:
            unfinished.unlink(missing_ok=True)


def remove(path: Path) -> None:
    """Remove a file, at its address too; nothing where there is none."""
    path.unlink(missing_ok=True)
    sent(path)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Name this file in an OSError that names none, as that of a full disk."""
    try:
        yield
    except OSError as error:
        if error.filename is not None:
            raise
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error


def write_bytes(path: Path | str, content: bytes) -> Path:
    """Write `content` to `path`, all or nothing (see `replacing`); return the path."""
    with replacing(path) as unfinished:
        unfinished.write_bytes(content)
    return Path(path)


def write_text(path: Path | str, text: str) -> Path:
    """Write `text` to `path` as UTF-8, all or nothing; return the path."""
    return write_bytes(path, text.encode())


def write_json(path: Path | str, content: Mapping[str, object]) -> Path:
    """Write indented JSON, all or nothing; return the path."""
    return write_text(path, json.dumps(content, indent=2) + "\n")


# `Path` makes one slash of two; a Windows drive is one letter
ADDRESS = re.compile(r"^([a-z][a-z0-9+.-]+):/+(?=[^/])")

_copies: dict[str, Path] = {}  # address -> its local copy


def local(path: Path | str) -> Path:
    """Return a local path as it is, and of an address the copy of the file or folder there.

    What is written to the copy, and into it, is sent to the address (see `sent`). Raises SpelgenError where the
    address cannot be reached, or names files outside itself.
    """
    match = ADDRESS.match(str(path))
    if match is None or Path(path).exists():
        return Path(path)
    if match[1] == "file":  # whose slashes `Path` has taken, too
        return Path("/" + str(path)[match.end() :])
    address = f"{match[1]}://{str(path)[match.end() :]}".rstrip("/")
    if address not in _copies:
        _copies[address] = _fetch(address)
    return _copies[address]


def sent(path: Path) -> None:
    """Send a file that was written to its address, or remove it there if it was removed here."""
    target = address_of(path)
    if target is None:
        return
    with reached(target) as (system, remote):
        if path.exists():
            system.makedirs(remote.rpartition("/")[0], exist_ok=True)
            system.put_file(str(path), remote)
        elif system.exists(remote):
            system.rm_file(remote)


def address_of(path: Path) -> str | None:
    """Return the address that a path is copied from; None of a local path."""
    for address, copy in _copies.items():
        if path == copy:
            return address
        if copy in path.parents:
            return f"{address}/{path.relative_to(copy).as_posix()}"
    return None


def with_addresses(text: str) -> str:
    """Return a text with addresses in place of their local copies."""
    for address, copy in _copies.items():
        text = text.replace(str(copy), address)
    return text


@contextmanager
def reached(address: str) -> Iterator[tuple[Any, str]]:
    """Yield the file system of an address, fsspec's, and the path there.

    Within it every exception becomes a SpelgenError that names the address: each file system raises kinds of its own.
    """
    try:
        import fsspec

        yield fsspec.core.url_to_fs(address)
    except SpelgenError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise SpelgenError(f"cannot be reached ({reason})", file=address) from error


def _fetch(address: str) -> Path:
    """Copy the file or folder at an address into a new temporary folder; return where it then lies."""
    folder = Path(tempfile.mkdtemp(prefix="spelgen-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    copy = _inside(folder, address.rpartition("/")[2], address)
    with reached(address) as (system, remote):
        if system.isdir(remote):
            copy.mkdir()
            for key in system.find(remote):
                target = _inside(copy, key.removeprefix(remote.rstrip("/")).lstrip("/"), address)
                target.parent.mkdir(parents=True, exist_ok=True)
                system.get_file(key, str(target))
        elif system.exists(remote):
            system.get_file(remote, str(copy))
    return copy


def _inside(folder: Path, name: str, address: str) -> Path:
    """Return where a name lies in a folder. Raises SpelgenError where it leads out of it.

    Archives and object stores take any text for a key, `../../.bashrc` too.
    """
    path = folder / name
    if folder.resolve() not in path.resolve().parents:
        raise SpelgenError(f"the key {name!r}", file=address, expected="keys inside the address alone")
    return path
