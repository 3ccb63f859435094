"""One training at a time in a run folder at an address: a file there names the holder for as long as it trains.

No kernel frees such a lock when its holder dies, so it grows old: it is refreshed with each checkpoint, and taken over
where its process is known to be gone, or where it was not refreshed for `STALE`.
"""

from __future__ import annotations

import json
import os
import secrets
import socket
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from spelgen.addresses import reached
from spelgen.errors import Diagnostic, RunError

NAME = ".lock"
STALE = 3600.0  # s; no stage between two checkpoints should take as long
REFRESH = 30.0  # s, at least between two writes

_held: dict[str, AddressLock] = {}  # by address


class AddressLock:
    """What this process holds at an address. took_over: what is to be told of a holder that is gone, or nothing."""

    def __init__(self, address: str) -> None:
        """Take it. Raises RunError that names who holds it, SpelgenError where the address cannot be reached."""
        self.address = address
        self._mine: dict[str, Any] = {
            "process": os.getpid(), "host": socket.gethostname(), "machine": uuid.getnode(),
            "since": time.strftime("%F %T"), "token": secrets.token_hex(8),
        }  # fmt: skip
        self.took_over: list[Diagnostic] = []
        with reached(f"{address}/{NAME}") as (system, place):
            system.makedirs(system._parent(place), exist_ok=True)
            try:
                _create(system, place, self._content())
            except FileExistsError:
                before = self._read(system, place)
                if not _gone(before):
                    raise self._refusal(before) from None
                message = f"the lock of {_told(before)} which is gone, is taken over"
                self.took_over.append(Diagnostic("warning", "stale-lock", address, None, message))
                system.pipe_file(place, self._content())
        self.refresh()

    def refresh(self) -> None:
        """Say that this process still trains. Raises RunError where another one has taken over."""
        with reached(f"{self.address}/{NAME}") as (system, place):
            found = self._read(system, place)
            if found.get("token") != self._mine["token"]:
                raise self._refusal(found)
            if time.time() - found["refreshed"] > REFRESH:
                system.pipe_file(place, self._content())

    def release(self) -> None:
        """Remove it, if it is still this process's."""
        with reached(f"{self.address}/{NAME}") as (system, place):
            if self._read(system, place).get("token") == self._mine["token"]:
                system.rm_file(place)

    def _content(self) -> bytes:
        return json.dumps(self._mine | {"refreshed": time.time()}).encode()

    @staticmethod
    def _read(system: Any, place: str) -> dict[str, Any]:
        """What the file says; nothing where it is gone or is no such file."""
        system.invalidate_cache()
        try:
            found = json.loads(system.cat_file(place))
        except (FileNotFoundError, ValueError):
            return {}
        return found if isinstance(found, dict) else {}

    def _refusal(self, holder: dict[str, Any]) -> RunError:
        return RunError(
            f"{_told(holder)} trains in this folder", file=self.address,
            do=f"wait for it, or -o another; where it is gone, remove {NAME} there",
        )  # fmt: skip


@contextmanager
def locked_address(address: str | None) -> Iterator[list[Diagnostic]]:
    """Keep others from training at an address, from this machine or another; None: nothing. What there is to tell.

    Raises as `AddressLock`.
    """
    if address is None:
        yield []
        return
    lock = _held[address] = AddressLock(address)
    try:
        yield lock.took_over
    finally:
        del _held[address]
        lock.release()


def refresh(address: str | None) -> None:
    """Of the lock that this process holds there, if it does (see `AddressLock.refresh`)."""
    if address in _held:
        _held[address].refresh()


def _create(system: Any, place: str, content: bytes) -> None:
    """Raises FileExistsError; not all file systems can do that in one step, so the file is read once more after it."""
    try:
        with system.open(place, "xb") as file:
            file.write(content)
    except (ValueError, NotImplementedError):
        system.pipe_file(place, content, mode="create")


def _gone(holder: dict[str, Any]) -> bool:
    """Whether a process of this machine has ended, or one of another has not been heard of for `STALE`."""
    if (holder.get("host"), holder.get("machine")) == (socket.gethostname(), uuid.getnode()):
        try:
            os.kill(int(holder["process"]), 0)
        except (ProcessLookupError, KeyError, TypeError, ValueError, OverflowError):
            return True
        except PermissionError:
            return False
    last = holder.get("refreshed")
    return not isinstance(last, int | float) or time.time() - last > STALE


def _told(holder: dict[str, Any]) -> str:
    if "process" not in holder:
        return "another process"
    return f"process {holder['process']} on {holder.get('host')}, since {holder.get('since')},"
