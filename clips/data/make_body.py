#!/usr/bin/env python3
"""Writes src/body/table.rs, the numbers of dm_control's CMU humanoid V2020 that forward kinematics needs.

    python3 make_body.py > ../src/body/table.rs        (needs ../../tests/python/requirements-tracking.txt)

They are MuJoCo's, of the compiled walker, so the XML's defaults, scale and `fromto` are resolved.
"""

import os

os.environ.setdefault("MUJOCO_GL", "disable")

import mujoco
from dm_control import mjcf
from dm_control.locomotion.arenas import floors
from dm_control.locomotion.tasks.reference_pose import utils
from dm_control.locomotion.walkers import cmu_humanoid

HEADER = """\
//! The compiled walker's numbers, made by `data/make_body.py` from dm_control 1.0.49 (Apache-2.0),
//! `CMUHumanoidPositionControlledV2020` in MuJoCo 3.17.0.
#![allow(clippy::approx_constant, clippy::excessive_precision, reason = "the compiled model's own digits")]

use super::parts::{Body, Geom, Shape};

"""
SHAPES = {int(mujoco.mjtGeom.mjGEOM_SPHERE): 1, int(mujoco.mjtGeom.mjGEOM_CAPSULE): 2, int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): 3}


def numbers(values):
    return "[" + ", ".join(repr(float(value)) for value in values) + "]"


def shape(kind, size):
    name = {1: "Sphere", 2: "Capsule", 3: "Ellipsoid"}[SHAPES[kind]]
    fields = {1: "radius: %r", 2: "radius: %r, half_length: %r", 3: "semi_axes: [%r, %r, %r]"}[SHAPES[kind]]
    return f"Shape::{name} {{ {fields % tuple(float(value) for value in size[:SHAPES[kind]])} }}"


def main():
    arena = floors.Floor()
    walker = utils.add_walker(cmu_humanoid.CMUHumanoidPositionControlledV2020, arena)
    physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
    model = physics.model.ptr
    first = physics.bind(mjcf.get_attachment_frame(walker.mjcf_model)).element_id
    name = lambda kind, index: (mujoco.mj_id2name(model, kind, index) or "").split("/")[-1]
    free = 1  # Joint 0 frees the root; the hinges follow in qpos order.

    print(HEADER, end="")
    print("/// Parents come before their children; the first is the free, massless frame, the second the root.")
    print("#[rustfmt::skip]")
    print(f"pub(super) static BODIES: [Body; {model.nbody - first}] = [")
    for body in range(first, model.nbody):
        start = max(model.body_jntadr[body] - free, 0) if body > first else 0
        count = model.body_jntnum[body] if body > first else 0
        anchors = [model.jnt_pos[free + start + hinge] for hinge in range(count)]
        assert all((anchor == anchors[0]).all() for anchor in anchors)
        anchor = anchors[0] if count else [0.0] * 3
        print(
            f'    Body {{ name: "{name(mujoco.mjtObj.mjOBJ_BODY, body) or "walker"}", '
            f"parent: {max(model.body_parentid[body] - first, 0)}, hinges: ({start}, {start + count}),"
            f" position: {numbers(model.body_pos[body])},\n           quaternion: {numbers(model.body_quat[body])},"
            f" anchor: {numbers(anchor)},\n           mass: {float(model.body_mass[body])!r},"
            f" center_of_mass: {numbers(model.body_ipos[body])} }},"
        )
    print("];\n\n/// The geoms that collide.")
    geoms = [geom for geom in range(model.ngeom) if model.geom_contype[geom] and model.geom_bodyid[geom] >= first]
    print("#[rustfmt::skip]")
    print(f"pub(super) static GEOMS: [Geom; {len(geoms)}] = [")
    for geom in geoms:
        print(
            f'    Geom {{ name: "{name(mujoco.mjtObj.mjOBJ_GEOM, geom)}", body: {model.geom_bodyid[geom] - first},'
            f" shape: {shape(int(model.geom_type[geom]), model.geom_size[geom])},\n           position:"
            f" {numbers(model.geom_pos[geom])},\n           quaternion: {numbers(model.geom_quat[geom])} }},"
        )
    print("];")


main()
