"""Motion capture: list, read, check, import and join files.

A source is ``builtin:NAME``, ``FILE.h5``, ``FILE.h5#SUBSET`` or ``FILE.h5#CLIP,CLIP``. Files have dm_control's layout.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from comic import _native
from comic.experiment import Clips, sources

__all__ = ["Clip", "builtin", "check", "entries", "import_cmu", "merge", "pose_to_action", "read"]

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Clip:
    """A motion of T frames, in the world's frame with z up."""

    name: str
    dt: float
    """Seconds from one frame to the next."""
    position: _Array
    """Of the root, metres, ``[T, 3]``."""
    quaternion: _Array
    """Of the root, w first, ``[T, 4]``."""
    joints: _Array
    """Joint angles in MuJoCo's order, rad, ``[T, 56]``."""
    velocity: _Array
    """Of the root, m/s, ``[T, 3]``."""
    angular_velocity: _Array
    """Of the root, rad/s, ``[T, 3]``."""
    joints_velocity: _Array
    """Of the joints, rad/s, ``[T, 56]``."""


def builtin() -> list[str]:
    """Names that can follow ``builtin:``."""
    return _native.builtin_clips()


def entries(source: Clips) -> list[dict[str, Any]]:
    """What is known of a source's clips without reading their motion.

    A dictionary for each clip: ``clip`` (its name), ``frames``, ``seconds``, ``dt``, ``model``, ``subsets`` (dm_control's
    named subsets that contain it), ``starts`` (first possible start frame and the end, or ``None``).
    """
    return _native.list_clips(sources(source))


def read(source: Clips) -> list[Clip]:
    """The clips of a source, or of several."""
    return [Clip(**clip) for clip in _native.read_clips(sources(source))]


def check(path: str | PathLike[str]) -> list[dict[str, Any]]:
    """The defects of a file's clips, one dictionary for each clip, as ``comic-actor clips check --json`` prints them."""
    checked: list[dict[str, Any]] = json.loads(_native.check_clips(str(path)))
    return checked


def import_cmu(
    asf: str | PathLike[str],
    amc: str | PathLike[str],
    out: str | PathLike[str],
    *,
    name: str | None = None,
    overwrite: bool = False,
    scale: float | None = None,
    sole_degrees: tuple[float, float] | None = None,
    floor: float | str | None = None,
    arm_regularisation: float | None = None,
    frames: tuple[int, int] | None = None,
) -> tuple[str, list[str]]:
    """Makes a file with one clip from a recording of the CMU database.

    Constants that are not given are computed from the recording.

    Args:
        asf: The skeleton.
        amc: The recording.
        out: The file to write.
        name: The clip's name; by default that of the recording's file.
        overwrite: Replaces a file that exists.
        scale: Scale of the motion.
        sole_degrees: Degrees to subtract from the left and the right ankle.
        floor: How the body is put on the floor, as ``comic-actor clips import --floor`` takes it.
        arm_regularisation: Weight that keeps fitted arms at the recorded angles.
        frames: First recorded frame and the end (excluded).

    Returns:
        The constants, as the options of ``comic-actor clips import``, and remarks.
    """
    path = Path(amc)
    return _native.import_clip(
        Path(asf),
        path,
        Path(out),
        path.stem if name is None else name,
        overwrite,
        scale,
        sole_degrees,
        None if floor is None else str(floor),
        arm_regularisation,
        frames,
    )


def pose_to_action(joints: npt.ArrayLike) -> _Array:
    """The actions whose servos aim at poses: ``[T, 56]`` for joint angles ``[T, 56]``, rad, in MuJoCo's order.

    They are in control order. -1 ... 1 is a joint's range; an angle beyond it is clipped.
    """
    return _native.poses_to_actions(np.ascontiguousarray(joints, dtype=np.float64))


def merge(source: Clips, out: str | PathLike[str], *, overwrite: bool = False) -> int:
    """Writes the clips of several sources to one file. Returns their number."""
    return _native.merge_clips(sources(source), Path(out), overwrite)
