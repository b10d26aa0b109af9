//! The specification of the humanoid: `CMUHumanoidPositionControlledV2020` and `CMUHumanoidPositionControlled`.

use comic_clips::WalkerModel;
use mujoco_rs::prelude::*;
use mujoco_rs::wrappers::mj_editing::{MjsBody, MjtLimited};

use super::names::END_EFFECTORS;
use super::servos::{self, FILTER_TIME_CONSTANT, Servo};
use crate::error::{Error, missing, refused};
use crate::{assets, silence};

/// Lengths and sizes of the V2020 body relative to its XML, and its mass in kg (`rescale_humanoid(self, 1.2, 1.2, 70)`).
const SCALE: f64 = 1.2;
const MASS: f64 = 70.0;
/// Density of a geom without a density of its own (kg/m³, MuJoCo's default).
const DENSITY: f64 = 1000.0;

/// The humanoid alone, without prefix and without floor.
pub(super) fn humanoid(model: WalkerModel) -> Result<MjSpec, Error> {
    let (xml, servos) = match model {
        WalkerModel::Cmu2019 => (assets::HUMANOID_2019, &servos::V2019),
        WalkerModel::Cmu2020 => (assets::HUMANOID_2020, &servos::V2020),
    };
    silence::install();
    let mut spec = MjSpec::from_xml_string(xml).map_err(refused("reading the humanoid's XML"))?;
    spec.set_modelname("walker");
    if model == WalkerModel::Cmu2020 {
        add_face(&mut spec)?;
        rescale(spec.world_body_mut());
        set_mass(&mut spec)?;
    }
    replace_motors(&mut spec, servos, model == WalkerModel::Cmu2020)?;
    add_end_effector_sensors(&mut spec)?;
    name_excludes(&mut spec)?;
    Ok(spec)
}

/// Adds the face and the nose, which show the direction of the head. They have no mass. Their body is a tracking body.
fn add_face(spec: &mut MjSpec) -> Result<(), Error> {
    let radius = spec.geom("head").ok_or_else(|| missing("geom", "head"))?.size()[0];
    let head = spec.body_mut("head").ok_or_else(|| missing("body", "head"))?;
    let forward = head.pos()[1] - 0.02;

    let face = head.add_geom_with_class("humanoid").map_err(refused("adding the face"))?;
    face.set_name("face").map_err(refused("adding the face"))?;
    face.set_type(MjtGeomBase::mjGEOM_CAPSULE);
    *face.size_mut() = [0.065, 0.014, face.size()[2]];
    *face.pos_mut() = [0.000341465, 0.048184, 0.01];
    *face.quat_mut() = [0.717887, 0.696142, -0.00493334, 0.0];
    face.set_mass(0.0);
    face.set_contype(0);
    face.set_conaffinity(0);

    let body = head.add_body();
    body.set_name("face").map_err(refused("adding the face"))?;
    *body.pos_mut() = [0.0, 0.039, forward];
    let nose = body.add_geom_with_class("humanoid").map_err(refused("adding the nose"))?;
    nose.set_name("nose").map_err(refused("adding the nose"))?;
    nose.set_type(MjtGeomBase::mjGEOM_CAPSULE);
    *nose.size_mut() = [radius / 4.75, 0.01, nose.size()[2]];
    *nose.quat_mut() = [1.0, 0.7, 0.0, 0.0];
    nose.set_mass(0.0);
    nose.set_contype(0);
    nose.set_conaffinity(0);
    // Group 1 is hidden from the humanoid's own camera (`_WALKER_INVIS_GROUP`).
    nose.set_group(1);
    Ok(())
}

/// `rescale_subtree`: scales every position, and every size that the element itself gives. Sizes from a class do not
/// change.
fn rescale(body: &mut MjsBody) {
    for joint in body.joint_iter_mut(false) {
        scale(joint.pos_mut());
    }
    for geom in body.geom_iter_mut(false) {
        scale(geom.pos_mut());
        let inherited = geom.default().map(|class| *class.geom().size());
        let kind = geom.type_();
        scale_own(geom.size_mut(), kind, inherited);
    }
    for site in body.site_iter_mut(false) {
        scale(site.pos_mut());
        let inherited = site.default().map(|class| *class.site().size());
        let kind = site.type_();
        scale_own(site.size_mut(), kind, inherited);
    }
    for camera in body.camera_iter_mut(false) {
        scale(camera.pos_mut());
    }
    for light in body.light_iter_mut(false) {
        scale(light.pos_mut());
    }
    for child in body.body_iter_mut() {
        scale(child.pos_mut());
        rescale(child);
    }
}

fn scale(vector: &mut [f64; 3]) {
    for value in vector {
        *value *= SCALE;
    }
}

/// Scales a size unless it is equal to the class's size. It scales as many numbers as the type has: MuJoCo fills the
/// rest of the vector, and dm_control does not know the rest.
fn scale_own(size: &mut [f64; 3], kind: MjtGeomBase, inherited: Option<[f64; 3]>) {
    if inherited == Some(*size) {
        return;
    }
    let count = match kind {
        MjtGeomBase::mjGEOM_SPHERE => 1,
        MjtGeomBase::mjGEOM_CAPSULE | MjtGeomBase::mjGEOM_CYLINDER => 2,
        _ => 3,
    };
    for value in &mut size[..count] {
        *value *= SCALE;
    }
}

/// The second half of `rescale_humanoid`: sets the densities so that the body, compiled alone, has the mass [`MASS`].
fn set_mass(spec: &mut MjSpec) -> Result<(), Error> {
    let alone = spec.compile().map_err(refused("weighing the humanoid"))?;
    let root = alone.name_to_id(MjtObjBase::mjOBJ_BODY, "root").ok_or_else(|| missing("body", "root"))?;
    let factor = MASS / alone.body_subtreemass()[root];
    for geom in spec.geom_iter_mut() {
        if geom.mass().is_nan() {
            geom.set_density(DENSITY * factor);
        } else {
            geom.set_mass(geom.mass() * factor);
        }
    }
    Ok(())
}

/// Replaces the XML's motors by position servos (`scaled_actuators.add_position_actuator`). Control −1 … 1 is the joint's
/// range.
fn replace_motors(spec: &mut MjSpec, servos: &[Servo], filtered: bool) -> Result<(), Error> {
    delete_actuators(spec)?;
    let main = spec.default_mut("main").ok_or_else(|| missing("default class", "main"))?;
    main.actuator_mut().set_forcelimited(MjtLimited::mjLIMITED_TRUE);
    for servo in servos {
        let joint = spec.joint_mut(servo.joint).ok_or_else(|| missing("joint", servo.joint))?;
        if let Some(damping) = servo.damping {
            joint.damping_mut()[0] = damping;
        }
        let [low, high] = *joint.range();
        let slope = (high - low) / 2.0;
        let actuator = spec.add_actuator_with_class("main").map_err(refused("adding a servo"))?;
        actuator.set_name(servo.joint).map_err(refused("adding a servo"))?;
        actuator.set_trntype(MjtTrn::mjTRN_JOINT);
        actuator.set_target(servo.joint);
        actuator.set_biastype(MjtBias::mjBIAS_AFFINE);
        actuator.gainprm_mut()[0] = servo.gain * slope;
        actuator.biasprm_mut()[..3].copy_from_slice(&[servo.gain * (low + slope), -servo.gain, 0.0]);
        actuator.set_ctrllimited(MjtLimited::mjLIMITED_TRUE);
        *actuator.ctrlrange_mut() = [-1.0, 1.0];
        *actuator.forcerange_mut() = [-servo.limit, servo.limit];
        if filtered {
            actuator.set_dyntype(MjtDyn::mjDYN_FILTER);
            actuator.dynprm_mut()[0] = FILTER_TIME_CONSTANT;
        }
    }
    Ok(())
}

#[allow(unsafe_code)]
fn delete_actuators(spec: &mut MjSpec) -> Result<(), Error> {
    while let Some(motor) = spec.actuator_iter_mut().next() {
        // SAFETY: this is the first actuator that still exists. It is deleted once, and its handle ends with this
        // statement.
        unsafe { motor.delete() }.map_err(refused("removing the motors"))?;
    }
    Ok(())
}

/// Adds the sensors of dm_control's observable `end_effectors_pos`, in the frame of the root.
fn add_end_effector_sensors(spec: &mut MjSpec) -> Result<(), Error> {
    for body in END_EFFECTORS {
        let sensor = spec.add_sensor();
        sensor.set_name(&format!("{body}_end_effector")).map_err(refused("adding a sensor"))?;
        sensor.set_type(MjtSensor::mjSENS_FRAMEPOS);
        sensor.set_objtype(MjtObjBase::mjOBJ_XBODY);
        sensor.set_objname(body);
        sensor.set_reftype(MjtObjBase::mjOBJ_XBODY);
        sensor.set_refname("root");
    }
    Ok(())
}

/// Names the contact exclusions as PyMJCF does. The addresses of names are arrays of the model, too.
fn name_excludes(spec: &mut MjSpec) -> Result<(), Error> {
    for (index, exclude) in spec.exclude_iter_mut().enumerate() {
        exclude.set_name(&format!("/unnamed_contact_{index}")).map_err(refused("naming an exclusion"))?;
    }
    Ok(())
}
