#!/usr/bin/env python3
"""Writes what is committed in cmu/ beside the ASF and AMC files: clips.h5 and motion.json.

    python3 make_recordings.py CLIPS.h5 OUTPUT_DIRECTORY        (needs h5py and numpy)

CLIPS.h5 holds clips in dm_control's layout that MuJoCo and dm_control made of CMU's recordings, among them those of
../../data/builtin.json. clips.h5: the clips of the recordings that lie beside it, every number as it was.
motion.json: the SHA-256 of the motion of each built-in clip, its arrays one after the other, each [frames, numbers] as
little-endian 64-bit floats.
"""

import hashlib
import json
import pathlib
import sys

import h5py
import numpy as np

MOTION = ("position", "quaternion", "joints", "velocity", "angular_velocity", "joints_velocity")


def main():
    source, out = (pathlib.Path(argument) for argument in sys.argv[1:3])
    takes = [take["key"] for take in json.loads((out / "manifest.json").read_text())]
    builtin = pathlib.Path(__file__).parent / "../../data/builtin.json"
    names = [clip["key"] for clip in json.loads(builtin.read_text())]
    with h5py.File(source) as file, h5py.File(out / "clips.h5", "w") as cut:
        for name in takes:
            file.copy(name, cut)
            walker = cut[name]["walkers/walker_0"]
            for field in [field for field in walker if isinstance(walker[field], h5py.Dataset)]:
                values = walker[field][()]
                del walker[field]
                walker.create_dataset(
                    field, data=values, chunks=values.shape, shuffle=True, compression="gzip", compression_opts=9
                )
        hashes = {}
        for name in names:
            walker = file[name]["walkers/walker_0"]
            numbers = b"".join(np.ascontiguousarray(walker[field][()].T, "<f8").tobytes() for field in MOTION)
            hashes[name] = hashlib.sha256(numbers).hexdigest()
    (out / "motion.json").write_text(json.dumps(hashes, indent=1) + "\n")


if __name__ == "__main__":
    main()
