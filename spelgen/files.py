"""Reading of regular files, atomic writing of files, and local copies of remote files.

An address is a URL of fsspec, such as `s3://bucket/logs`. All other modules work on local paths: an address is copied
to a temporary folder, which exists until the process ends, and files written to this folder are uploaded to the
address.
"""

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

# Largest JSON or Python file that is read [bytes]: parsed, it takes about thirty times this memory.
MAX_BYTES = 2**25


def require_regular_file(path: Path, error: type[SpelgenError], expected: str | None = None) -> None:
    """Raise ``error`` unless a path is a regular file: reading a pipe or a device may not end.

    expected: description of the expected file, for the message.
    """
    if not path.is_file():
        raise error("no regular file", file=path, expected=expected)


def read_bytes(
    path: Path,
    error: type[SpelgenError],
    kind: str | None = None,
    largest: int = MAX_BYTES,
    do: str | None = None,
) -> bytes:
    """Return the bytes of a regular file.

    Args:
        path: the file.
        error: exception for an absent, unreadable or too large file.
        kind: description of the expected file, for the message about a path that is no regular file; None: omitted.
        largest: largest size [bytes].
        do: advice in the message about a file that is too large; None: no advice.
    """
    try:
        # The size of the file is checked before it is read: a sparse file can have many gigabytes without occupying
        # disk space.
        size = path.stat().st_size
        require_regular_file(path, error, kind)
        # The parsers of JSON and Python cannot be interrupted, so the size of their input is limited.
        if size <= largest:
            return path.read_bytes()
    except FileNotFoundError:
        raise error("no such file", file=path) from None
    except (OSError, ValueError) as problem:  # `stat` raises ValueError for a path with a null character
        reason = problem.strerror if isinstance(problem, OSError) else None
        raise error(f"cannot be read ({reason or problem})", file=path) from None
    raise error(f"a file of {size} bytes", file=path, expected=f"at most {largest}", do=do)


def read_json(path: Path, error: type[SpelgenError]) -> dict[str, Any]:
    """Return the object in a JSON file. Raises ``error`` if the file is absent, malformed, or contains no object."""
    try:
        content = json.loads(read_bytes(path, error))
    except (ValueError, RecursionError) as problem:
        raise error(f"broken JSON ({problem})", file=path) from problem
    # All JSON files of spelgen are objects, because later versions can add keys to an object.
    if not isinstance(content, dict):
        raise error(f"{type(content).__name__} in JSON", file=path, expected="an object")
    return content


@contextmanager
def limited_memory(size: int) -> Iterator[None]:
    """Context manager that limits the additional memory of the process to ``size`` bytes.

    A larger allocation raises MemoryError. File readers of third-party packages allocate the size that a file states,
    without checking it. The limit has an effect on Linux only.
    """
    try:
        import resource

        # Linux limits the whole address space, so the current size of the process is added to `size`.
        pages = int(Path("/proc/self/statm").read_text().split()[0])
    except (ImportError, OSError):
        yield
        return
    previous, largest = resource.getrlimit(resource.RLIMIT_AS)
    allowed = pages * resource.getpagesize() + size
    if largest != resource.RLIM_INFINITY:
        allowed = min(allowed, largest)
    resource.setrlimit(resource.RLIMIT_AS, (allowed, largest))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (previous, largest))


@contextmanager
def replacing(path: Path | str) -> Iterator[Path]:
    """Context manager that yields a hidden file, which at the end replaces `path` atomically, even if power fails.

    An absent folder is created. If `path` is in the local copy of a remote address such as `s3://bucket/logs`, the file
    is also uploaded. An interrupted or failed write does not change `path`. Raises OSError with the path if the file
    cannot be written, for instance on a full disk.
    """
    path = Path(path)
    with naming(path):
        # An absent output folder is created: otherwise a command would fail after minutes of work.
        path.parent.mkdir(parents=True, exist_ok=True)
        # The hidden file is in the folder of `path`, because renaming is atomic only within one file system.
        unfinished = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        try:
            yield unfinished
            # fsync puts the content on disk before the file is renamed: a power failure cannot result in an empty file.
            with unfinished.open("rb+") as file:
                os.fsync(file.fileno())
            os.replace(unfinished, path)
            sent(path)
        finally:
            unfinished.unlink(missing_ok=True)


def remove(path: Path) -> None:
    """Remove a file if it exists. If it is the local copy of a remote file, also remove the remote file."""
    path.unlink(missing_ok=True)
    sent(path)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Context manager that sets `path` as the file name of an OSError about this file; other errors are unchanged.

    Such an error may have no file name, as on a full disk, or the name of the hidden file that `replacing` writes
    before it is renamed to `path`. It is recognised by a file name that is absent or contains the name of `path`.
    """
    try:
        yield
    except OSError as error:
        if error.filename is not None and path.name not in str(error.filename):
            raise
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error


def write_bytes(path: Path | str, content: bytes) -> Path:
    """Write `content` to `path`, all or nothing (see `replacing`); return the path."""
    with replacing(path) as unfinished:
        unfinished.write_bytes(content)
    return Path(path)


def write_text(path: Path | str, text: str) -> Path:
    """Write `text` to `path` as UTF-8, all or nothing (see `replacing`); return the path."""
    return write_bytes(path, text.encode())


def write_json(path: Path | str, content: Mapping[str, object]) -> Path:
    """Write `content` to `path` as indented JSON, all or nothing (see `replacing`); return the path."""
    return write_text(path, json.dumps(content, indent=2) + "\n")


# One slash is accepted after the scheme of an address, because `Path` reduces two slashes to one. A scheme has at least
# two letters, because `C:/` is a drive of Windows.
ADDRESS = re.compile(r"^([a-z][a-z0-9+.-]+):/+(?=[^/])")

_copies: dict[str, Path] = {}  # {address: path of its local copy}


def local(path: Path | str) -> Path:
    """Return the path of the local copy of a remote file or folder; a local path is returned unchanged.

    Files written to the copy are uploaded (see `sent`). Raises SpelgenError if the address cannot be reached, or if a
    key of the object store would be copied to a path outside the copy.
    """
    # A local file whose name has the form of an address takes precedence over the address.
    match = ADDRESS.match(str(path))
    if match is None or Path(path).exists():
        return Path(path)
    if match[1] == "file":  # `Path` changes file:///x to file:/x, so any number of slashes is accepted
        return Path("/" + str(path)[match.end() :])
    address = f"{match[1]}://{str(path)[match.end() :]}".rstrip("/")
    if address not in _copies:
        _copies[address] = _fetch(address)
    return _copies[address]


def sent(path: Path) -> None:
    """Upload the local copy of a remote file. If the local copy was removed, remove the remote file.

    Files that are no local copies are ignored.
    """
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
    """Return the address whose local copy is at `path`; None if `path` is no local copy."""
    for address, copy in _copies.items():
        if path == copy:
            return address
        if copy in path.parents:
            return f"{address}/{path.relative_to(copy).as_posix()}"
    return None


def with_addresses(text: str) -> str:
    """Return a message in which paths of local copies are replaced by the addresses that the user has typed."""
    for address, copy in _copies.items():
        text = text.replace(str(copy), address)
    return text


@contextmanager
def reached(address: str) -> Iterator[tuple[Any, str]]:
    """Context manager that yields the fsspec file system of an address, and the path on this file system.

    Every exception in the block becomes a SpelgenError with the address: file systems raise their own types.
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
    """Copy the file or folder at an address into a new temporary folder; return the path of the copy."""
    folder = Path(tempfile.mkdtemp(prefix="spelgen-"))
    # Local copies are removed at the end of the process: written results are uploaded immediately.
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    # The local copy of a remote file has the same name, because the suffix of the name selects the reader.
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
    """Return the path of the key `name` in a folder. Raises SpelgenError if the path is outside the folder.

    address: address of the archive or object store, for the error.

    Archives and object stores accept any text as a key, such as `../../.bashrc`.
    """
    path = folder / name
    if folder.resolve() not in path.resolve().parents:
        raise SpelgenError(f"the key {name!r}", file=address, expected="only keys inside the address")
    return path
