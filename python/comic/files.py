"""Files that survive a kill, and locks that end with their process."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from comic import _native

__all__ = ["append", "locked", "replace"]

_POLL = 0.1


@contextmanager
def locked(path: Path, problem: str, patience: float = 0.0) -> Iterator[None]:
    """Holds the lock on a file, which is made if it does not exist.

    Args:
        path: The file.
        problem: What an error says after the path.
        patience: Seconds to wait for another process that holds the lock.

    Raises:
        comic.Error: Another process still holds the lock, or the file cannot be written.
    """
    deadline = time.monotonic() + patience
    try:
        file = path.open("a")
    except OSError as error:
        raise _unwritable(path, error) from error
    with file:
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() >= deadline:
                    raise _native.Error(f"{path}: {problem}") from None
                time.sleep(_POLL)
        yield


def replace(path: Path, lines: Iterable[str]) -> None:
    """Writes a file, or replaces it. Whenever the process is killed, the old text or the new one is there, whole.

    Raises:
        comic.Error: The file cannot be written.
    """
    new = path.with_name(f"{path.name}.new")
    try:
        with new.open("w", encoding="utf-8") as file:
            file.writelines(lines)
            file.flush()
            os.fsync(file.fileno())
        new.replace(path)
    except OSError as error:
        raise _unwritable(path, error) from error


def append(path: Path, line: str) -> None:
    """Adds a line to a file, and waits until the disk has it.

    Raises:
        comic.Error: The file cannot be written.
    """
    try:
        with path.open("a", encoding="utf-8") as file:
            file.write(f"{line}\n")
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise _unwritable(path, error) from error


def _unwritable(path: Path, error: OSError) -> _native.Error:
    return _native.Error(f"{path}: it cannot be written ({error.strerror}): check the directory's permissions and space")
