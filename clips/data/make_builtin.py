#!/usr/bin/env python3
"""Writes builtin.bin and builtin.json, the clips compiled into the programs, from an HDF5 file in dm_control's layout.

    python3 make_builtin.py CLIPS.h5 MANIFEST.json OUTPUT_DIRECTORY        (needs h5py and numpy)

builtin.bin, little-endian:
    8 bytes   magic "COMICLIP"
    u32       format version, 1
    u32       number of clips
    per clip  name, 16 bytes of ASCII padded with zeros; f64 dt (s); u32 frames T; u32 zero
    per clip, in the same order, float64 arrays, frame after frame:
              position [T, 3] m; quaternion [T, 4] w x y z; joints [T, 56] rad, in qpos order;
              velocity [T, 3] m/s, world; angular_velocity [T, 3] rad/s, root-local; joints_velocity [T, 56] rad/s

builtin.json: the manifest's entries of these clips, word for word (source files, frame windows, constants).
"""

import json
import pathlib
import struct
import sys

import h5py
import numpy as np

CLIPS = [
    "CMU_002_01",  # walk
    "CMU_002_02",  # walk, brisk
    "CMU_002_03",  # run
    "CMU_002_04",  # vertical jump, balance
    "CMU_005_01",  # walk
    "CMU_007_01",  # walk
    "CMU_007_04",  # slow walk
    "CMU_013_30",  # squats
    "CMU_013_31",  # jog in place
    "CMU_013_39",  # forward jump
    "CMU_086_09_a",  # walk around with turns
]
FIELDS = ["position", "quaternion", "joints", "velocity", "angular_velocity", "joints_velocity"]
CMU_2020 = 4


def main():
    source, manifest, output = sys.argv[1], sys.argv[2], pathlib.Path(sys.argv[3])
    headers, arrays = [], []
    with h5py.File(source, "r") as file:
        for name in CLIPS:
            clip = file[name]
            walker = clip["walkers/walker_0"]
            assert walker.attrs["model"] == CMU_2020, name
            headers.append(struct.pack("<16sdII", name.encode(), clip.attrs["dt"], clip.attrs["num_steps"], 0))
            arrays += [np.ascontiguousarray(walker[field][()].T).astype("<f8").tobytes() for field in FIELDS]
    binary = b"COMICLIP" + struct.pack("<II", 1, len(CLIPS)) + b"".join(headers) + b"".join(arrays)
    (output / "builtin.bin").write_bytes(binary)
    entries = {entry["key"]: entry for entry in json.load(open(manifest))}
    text = json.dumps([entries[name] for name in CLIPS], indent=1)
    (output / "builtin.json").write_text(text + "\n")


main()
