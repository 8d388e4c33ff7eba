"""One process writes a store: a lock that the operating system lets go of when its holder dies.

`flock(2)` locks an open file, not its name, and ends with the process however it ends; so a lock is never
stale, and the file that a dead process has left is taken over.  The file says who holds it.  It is removed
by the holder while it is still locked, and whoever gets the lock checks that the name still means the file
that was locked.

A forked child has a copy of the open file, which would keep the lock when its parent has died: it closes
it.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import time
import weakref
from pathlib import Path
from typing import Final

from factored_polca.studies.provenance import machine, now

_HELD: Final[weakref.WeakSet[StoreLock]] = weakref.WeakSet()

TRIES: Final = 5
"""How often the lock is asked for: `is_locked` holds it for a moment."""


class StoreLocked(Exception):
    """Another process writes the store; the message says which."""


class StoreLock:
    """The right to write a store, held until `release` or the end of the process."""

    def __init__(self, store: Path) -> None:
        """Take the lock.

        Raises:
            StoreLocked: another process has it.
            OSError: the folder can't be written to, or its file system has no locks.
        """
        self.path = lock_path(store)
        self._file = self._locked(store)
        _HELD.add(self)
        holder = {"process": os.getpid(), "host": machine()["host"], "since": now()}
        os.ftruncate(self._file, 0)
        os.pwrite(self._file, json.dumps(holder).encode(), 0)

    def _locked(self, store: Path) -> int:
        tries = TRIES
        while True:
            file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if os.path.samestat(os.fstat(file), os.stat(self.path)):
                    return file
            except FileNotFoundError:
                pass  # its last holder has just removed it
            except OSError as error:
                os.close(file)
                if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
                    raise
                tries -= 1
                if tries:
                    time.sleep(0.05)
                    continue
                raise StoreLocked(
                    f"{store}: {holder_text(store)} is writing it: wait for it, or stop it; studies go on "
                    "where they were"
                ) from None
            os.close(file)

    def release(self) -> None:
        """Let go of the store."""
        if self._file >= 0:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(self.path)
            self.close()

    def close(self) -> None:
        """Close the file and leave it there; the lock ends when no process has it open any more."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


def _close_in_child() -> None:
    for lock in list(_HELD):
        lock.close()


os.register_at_fork(after_in_child=_close_in_child)


def lock_path(store: Path) -> Path:
    """The file that stands for the right to write `store`."""
    return store.with_name(store.name + ".lock")


def holder_text(store: Path) -> str:
    """Who holds the lock, in words."""
    try:
        said = json.loads(lock_path(store).read_bytes()[:1000])
        process, host, since = said["process"], said["host"], said["since"]
        return f"the process {process:d} on {host} (since {since})"
    except (OSError, ValueError, KeyError, TypeError):
        return "another process"


def is_locked(store: Path) -> bool:
    """Whether a process writes the store now; a file that a dead one has left doesn't count."""
    try:
        file = os.open(lock_path(store), os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(file)
    return False
