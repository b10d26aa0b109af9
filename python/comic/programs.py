"""Finds and starts the programs ``comic-learner`` and ``comic-actor``."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import comic

__all__ = ["child", "find", "run"]

# Asks Linux for SIGTERM at the parent's end, and becomes the program.
_CHILD = """
import ctypes, os, signal, sys
ctypes.CDLL(None).prctl(1, signal.SIGTERM)
if os.getppid() != int(sys.argv[1]):
    sys.exit("the process that started this one has ended")
os.execv(sys.argv[2], sys.argv[2:])
"""


def find(name: str) -> Path:
    """The path of a program.

    Raises:
        comic.Error: It is neither in the directory that ``COMIC_BIN`` names nor in one of ``PATH``.
    """
    directory = os.environ.get("COMIC_BIN")
    found = shutil.which(name, path=directory)
    if found is None:
        where = "PATH has no directory with it" if directory is None else f"COMIC_BIN is {directory}, which has none"
        raise comic.Error(
            f"there is no program {name}: {where}. In a checkout of the repository `cargo build --release` builds it; then "
            f"set COMIC_BIN to the checkout's target/release"
        )
    return Path(found)


def run(name: str, arguments: Sequence[str]) -> str:
    """What a program prints.

    Raises:
        comic.Error: The program fails. The message is the program's.
    """
    ended = subprocess.run([find(name), *arguments], capture_output=True, text=True, check=False)
    if ended.returncode != 0:
        raise comic.Error(ended.stderr.strip() or f"{name} ended with {ended.returncode}")
    return ended.stdout


def child(name: str, arguments: Sequence[str], log: Path) -> subprocess.Popen[bytes]:
    """Starts a program that ends when this thread ends. Its output is appended to a file."""
    command = [sys.executable, "-c", _CHILD, str(os.getpid()), str(find(name)), *arguments]
    with log.open("ab") as output:
        return subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT
        )
