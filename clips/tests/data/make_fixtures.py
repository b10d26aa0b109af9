#!/usr/bin/env python3
"""Writes tiny.h5 and defects.h5, the fixtures of these tests.

    python3 make_fixtures.py OUTPUT_DIRECTORY [SEED]        (needs h5py and numpy; the committed files have seed 1)

tiny.h5: two sound V2020 clips in dm_control's layout, with its file format (superblock 0, symbol tables, shuffle +
deflate). defects.h5: one clip for each defect, with the defect's name, a sound clip and a sound V2019 clip, in the
newest file format. Hard links lead to one copy of each sound dataset.
Every number is a multiple of 1/64, so the files stay small.
"""

import pathlib
import sys

import h5py
import numpy as np

DIMENSIONS = dict(
    position=3, quaternion=4, joints=56, velocity=3, angular_velocity=3, joints_velocity=56,
    center_of_mass=3, end_effectors=12, appendages=15,
)


def fields(random, bodies, steps):
    dimensions = dict(DIMENSIONS, body_positions=3 * bodies, body_quaternions=4 * bodies)
    arrays = {name: random.integers(-32, 33, (size, steps)) / 64 for name, size in dimensions.items()}
    for name in ("quaternion", "body_quaternions"):
        quaternions = np.zeros((dimensions[name] // 4, 4, steps))
        chosen = random.integers(0, 4, (dimensions[name] // 4, steps))
        np.put_along_axis(quaternions, chosen[:, None, :], 1.0, axis=1)
        arrays[name] = quaternions.reshape(dimensions[name], steps)
    return arrays


def attributes(clip, model, dt, steps):
    for name in ("year", "month", "day"):
        clip.attrs[name] = np.int64(0)
    clip.attrs["dt"], clip.attrs["num_steps"] = dt, steps
    clip.create_group("props")
    walker = clip.create_group("walkers").create_group("walker_0")
    walker.attrs["name"], walker.attrs["model"], walker.attrs["mass"] = np.bytes_(b"walker"), np.int64(model), 0.0
    for name in ("end_effector_names", "appendage_names"):
        walker.attrs[name] = np.array([], dtype="S1")
    walker.create_group("markers")
    walker.create_group("scaling")
    return walker


def tiny(path, random):
    with h5py.File(path, "w", libver="earliest") as file:
        for name, steps in (("TINY_001_01", np.int64(12)), ("TINY_001_02", np.int64(9))):
            walker = attributes(file.create_group(name), 4, 0.03, steps)
            for field, values in fields(random, 31, steps).items():
                walker.create_dataset(
                    field, data=values, chunks=values.shape, shuffle=True, compression="gzip", compression_opts=9
                )


def defects(path, random):
    steps = 3
    sound = fields(random, 31, steps)
    with h5py.File(path, "w", libver="latest") as file:
        first = None

        def clip(name, model=4, dt=0.03, num_steps=np.int64(steps), without=(), **replaced):
            nonlocal first
            walker = attributes(file.create_group(name), model, dt, num_steps)
            for field, values in sound.items():
                if field in replaced:
                    walker.create_dataset(field, data=replaced[field])
                elif field not in without and first is None:
                    walker.create_dataset(field, data=values)
                elif field not in without:
                    walker[field] = first[field]
            first = first or walker

        def changed(field, index, value):
            values = sound[field].copy()
            values[index] = value
            return {field: values}

        clip("sound")
        bodies_2019 = dict(body_positions=sound["body_positions"][3:], body_quaternions=sound["body_quaternions"][4:])
        clip("sound_2019", model=1, dt=0.05, **bodies_2019)
        clip("joints_missing", without=("joints",))
        clip("joints_transposed", joints=sound["joints"].T)
        clip("joints_narrow", joints=sound["joints"][:55])
        clip("joints_integers", joints=np.zeros((56, steps), np.int32))
        clip("position_flat", position=sound["position"].ravel())
        clip("velocity_short", velocity=sound["velocity"][:, :2])
        clip("joints_nan", **changed("joints", (5, 1), np.nan))
        clip("center_of_mass_infinite", **changed("center_of_mass", (2, 2), np.inf))
        clip("quaternion_zero", **changed("quaternion", (slice(None), 1), 0.0))
        clip("body_quaternion_long", **changed("body_quaternions", (slice(8, 12), 2), 1.0))
        clip("bodies_of_2019", body_positions=sound["body_positions"][:90])
        clip("steps_many", num_steps=np.int64(4))
        clip("steps_zero", num_steps=np.int64(0))
        clip("steps_negative", num_steps=np.int64(-3))
        clip("steps_huge", num_steps=np.uint64(2**63 + 5))
        clip("steps_text", num_steps=np.bytes_(b"three"))
        clip("dt_zero", dt=0.0)
        clip("dt_nan", dt=np.nan)
        clip("dt_huge", dt=30.0)
        clip("model_unknown", model=2)
        del file["steps_text"].attrs["dt"]
        file.create_group("dt_missing").attrs["num_steps"] = np.int64(steps)
        walkerless = file.create_group("walker_missing")
        walkerless.attrs["num_steps"], walkerless.attrs["dt"] = np.int64(steps), 0.03
        file.create_dataset("no_clip", data=np.zeros(3))


def main():
    output, seed = pathlib.Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 1
    tiny(output / "tiny.h5", np.random.default_rng(seed))
    defects(output / "defects.h5", np.random.default_rng(seed))


main()
