"""Files that survive a kill, and locks that end with their process."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from comic import _native

__all__ = ["locked", "replace"]

_POLL = 0.1


@contextmanager
def locked(path: Path, problem: str, patience: float = 0.0) -> Iterator[None]:
    """Holds the lock on a file, which is made if it does not exist.

    Args:
        path: The file.
        problem: What an error says after the path.
        patience: Seconds to wait for another process that holds the lock.

    Raises:
        comic.Error: Another process still holds the lock.
    """
    deadline = time.monotonic() + patience
    with path.open("a") as file:
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
    """Writes a file, or another text in its place. Whenever the process is killed, one of the two is there, whole."""
    new = path.with_name(f"{path.name}.new")
    with new.open("w") as file:
        file.writelines(lines)
        file.flush()
        os.fsync(file.fileno())
    new.replace(path)
