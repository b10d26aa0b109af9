//! The skeletons of several programs.

use super::*;
use crate::retarget::{RecordedBone, RecordedPose};
use crate::spatial::IDENTITY;

/// A skeleton with these bones. A name is indented by two spaces for each bone above it.
fn skeleton(tree: &str) -> Recorded {
    let mut above: Vec<usize> = Vec::new();
    let mut bones: Vec<RecordedBone> = Vec::new();
    for line in tree.lines().filter(|line| !line.trim().is_empty()) {
        above.truncate((line.len() - line.trim_start().len()) / 2);
        let (name, parent) = (line.trim().to_string(), above.last().copied());
        above.push(bones.len());
        bones.push(RecordedBone { name, parent, offset: [0.0, 1.0, 0.0], end: None });
    }
    let rotations = vec![IDENTITY; bones.len()];
    let frames = vec![RecordedPose { position: [0.0; 3], rotations }];
    Recorded { path: "a.bvh".into(), bones, rest_in_world: true, frame_seconds: 0.01, frames }
}

/// A skeleton: spine, neck and head from below; then the limbs of a side, whose names are made by `sided`.
fn person(trunk: &[&str], head: &[&str], arm: &[&str], leg: &[&str], sided: impl Fn(&str, bool) -> String) -> Recorded {
    let mut tree = String::new();
    let mut line = |depth: usize, name: &str| tree += &format!("{}{name}\n", "  ".repeat(depth));
    for (depth, name) in trunk.iter().enumerate() {
        line(depth, name);
    }
    for (depth, name) in head.iter().enumerate() {
        line(trunk.len() + depth, name);
    }
    for (limb, start) in [(arm, trunk.len()), (leg, 1)] {
        for left in [true, false] {
            for (depth, name) in limb.iter().enumerate() {
                line(start + depth, &sided(name, left));
            }
        }
    }
    skeleton(&tree)
}

/// `Left` or `Right` before the name.
fn whole(name: &str, left: bool) -> String {
    format!("{}{name}", if left { "Left" } else { "Right" })
}

/// The roles with a bone, as `role=bone` for the middle and the left.
fn found(recorded: &Recorded) -> String {
    let roles = find_roles(recorded);
    roles.check(recorded).unwrap();
    let name = |role| roles.get(role).map(|bone| recorded.bones[bone].name.as_str());
    let middle = Role::all().filter(|role| !role.name().starts_with("right"));
    let pairs = middle.filter_map(|role| Some(format!("{}={}", role.name(), name(role)?)));
    pairs.collect::<Vec<String>>().join(" ")
}

#[test]
fn cmu_and_motion_builder() {
    let arm = ["Shoulder", "Arm", "ForeArm", "Hand", "FingerBase", "HandIndex1"];
    let leg = ["HipJoint", "UpLeg", "Leg", "Foot", "ToeBase"];
    // LHipJoint, but LeftUpLeg.
    let sided = |name: &str, left: bool| match name {
        "HipJoint" => if left { "LHipJoint" } else { "RHipJoint" }.to_string(),
        name => whole(name, left),
    };
    let cmu = person(&["Hips", "LowerBack", "Spine", "Spine1"], &["Neck", "Neck1", "Head"], &arm, &leg, sided);
    assert_eq!(
        found(&cmu),
        "pelvis=Hips spine=LowerBack chest=Spine upper_chest=Spine1 neck=Neck upper_neck=Neck1 head=Head \
         left_clavicle=LeftShoulder left_upper_arm=LeftArm left_forearm=LeftForeArm left_hand=LeftHand \
         left_fingers=LeftFingerBase left_thigh=LeftUpLeg left_shin=LeftLeg left_foot=LeftFoot left_toes=LeftToeBase"
    );
}

/// The names in the database's own ASF files, which some converters keep.
#[test]
fn cmu_itself() {
    let cmu = person(
        &["root", "lowerback", "upperback", "thorax"],
        &["lowerneck", "upperneck", "head"],
        &["clavicle", "humerus", "radius", "wrist", "hand", "fingers"],
        &["hipjoint", "femur", "tibia", "foot", "toes"],
        |name, left| format!("{}{name}", if left { 'l' } else { 'r' }),
    );
    assert_eq!(
        found(&cmu),
        "pelvis=root spine=lowerback chest=upperback upper_chest=thorax neck=lowerneck upper_neck=upperneck head=head \
         left_clavicle=lclavicle left_upper_arm=lhumerus left_forearm=lradius left_hand=lhand left_fingers=lfingers \
         left_thigh=lfemur left_shin=ltibia left_foot=lfoot left_toes=ltoes"
    );
}

#[test]
fn lafan1_mixamo_and_rokoko() {
    let trunk = ["Hips", "Spine", "Spine1", "Spine2"];
    let arm = ["Shoulder", "Arm", "ForeArm", "Hand"];
    let expected = "pelvis=Hips spine=Spine chest=Spine1 upper_chest=Spine2 neck=Neck head=Head \
         left_clavicle=LeftShoulder left_upper_arm=LeftArm left_forearm=LeftForeArm left_hand=LeftHand";
    let lafan1 = person(&trunk, &["Neck", "Head"], &arm, &["UpLeg", "Leg", "Foot", "Toe"], whole);
    let legs = "left_thigh=LeftUpLeg left_shin=LeftLeg left_foot=LeftFoot left_toes=LeftToe";
    assert_eq!(found(&lafan1), format!("{expected} {legs}"));
    let mut mixamo = lafan1.clone();
    for bone in &mut mixamo.bones {
        bone.name = format!("mixamorig_{}", bone.name);
    }
    assert_eq!(find_roles(&mixamo), find_roles(&lafan1));
    let rokoko = person(&trunk, &["Neck", "Head"], &arm, &["Thigh", "Shin", "Foot", "Toe"], whole);
    let legs = "left_thigh=LeftThigh left_shin=LeftShin left_foot=LeftFoot left_toes=LeftToe";
    assert_eq!(found(&rokoko), format!("{expected} {legs}"));
}

#[test]
fn skeletons_of_joints() {
    let sided = |name: &str, left: bool| format!("{}_{name}", if left { "left" } else { "right" });
    let smpl = person(
        &["pelvis", "spine1", "spine2", "spine3"],
        &["neck", "head"],
        &["collar", "shoulder", "elbow", "wrist", "hand"],
        &["hip", "knee", "ankle", "foot"],
        sided,
    );
    assert_eq!(
        found(&smpl),
        "pelvis=pelvis spine=spine1 chest=spine2 upper_chest=spine3 neck=neck head=head left_clavicle=left_collar \
         left_upper_arm=left_shoulder left_forearm=left_elbow left_hand=left_wrist left_thigh=left_hip \
         left_shin=left_knee left_foot=left_ankle left_toes=left_foot"
    );
    let xsens = person(
        &["Hips", "Chest", "Chest2", "Chest3", "Chest4"],
        &["Neck", "Head"],
        &["Collar", "Shoulder", "Elbow", "Wrist"],
        &["Hip", "Knee", "Ankle", "Toe"],
        whole,
    );
    assert!(found(&xsens).starts_with("pelvis=Hips spine=Chest chest=Chest3 upper_chest=Chest4 neck=Neck head=Head"));
    assert!(found(&xsens).ends_with("left_foot=LeftAnkle left_toes=LeftToe"));
}

#[test]
fn sides_at_the_end_and_a_common_beginning() {
    let trunk = ["pelvis", "spine_01", "spine_02"];
    let leg = ["thigh", "calf", "foot", "ball"];
    for side in [["_l", "_r"], [".L", ".R"], ["-left", "-right"], [" L", " R"]] {
        let unreal = person(
            &trunk,
            &["neck_01", "head"],
            &["clavicle", "upperarm", "lowerarm", "hand", "middle_01"],
            &leg,
            |name, left| format!("{name}{}", side[usize::from(!left)]),
        );
        let roles = find_roles(&unreal);
        roles.check(&unreal).unwrap();
        assert_eq!(Role::all().filter(|role| roles.get(*role).is_some()).count(), 23, "{side:?}");
    }
}

#[test]
fn a_biped_whose_neck_carries_the_arms() {
    let max = person(
        &["Bip01 Pelvis", "Bip01 Spine", "Bip01 Spine1", "Bip01 Spine2", "Bip01 Neck"],
        &["Bip01 Head"],
        &["Clavicle", "UpperArm", "Forearm", "Hand", "Finger2"],
        &["Thigh", "Calf", "Foot", "Toe0"],
        |name, left| format!("Bip01 {} {name}", if left { 'L' } else { 'R' }),
    );
    assert_eq!(
        found(&max),
        "pelvis=Bip01 Pelvis spine=Bip01 Spine chest=Bip01 Spine1 upper_chest=Bip01 Spine2 neck=Bip01 Neck head=Bip01 Head \
         left_clavicle=Bip01 L Clavicle left_upper_arm=Bip01 L UpperArm left_forearm=Bip01 L Forearm \
         left_hand=Bip01 L Hand left_fingers=Bip01 L Finger2 left_thigh=Bip01 L Thigh left_shin=Bip01 L Calf \
         left_foot=Bip01 L Foot left_toes=Bip01 L Toe0"
    );
}

#[test]
fn a_skeleton_with_few_bones() {
    let few = person(
        &["Hips", "Spine"],
        &["Head"],
        &["Shoulder", "Arm", "ForeArm", "Hand"],
        &["UpLeg", "Leg", "Foot"],
        whole,
    );
    assert!(found(&few).starts_with("pelvis=Hips spine=Spine head=Head left_clavicle=LeftShoulder"));
    assert!(found(&few).ends_with("left_foot=LeftFoot"));
}

#[test]
fn a_file_of_bones_replaces_and_removes_roles() {
    let odd = person(
        &["A", "B"],
        &["Head"],
        &["Schulter", "Ober", "ForeArm", "Hand"],
        &["UpLeg", "Leg", "Foot", "Toe"],
        whole,
    );
    let message = find_roles(&odd).check(&odd).unwrap_err().to_string();
    assert!(
        message.contains("left_upper_arm") && message.contains("LeftOber") && message.contains("--bones FILE"),
        "{message}"
    );
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("bones");
    let read = |text: &str| {
        std::fs::write(&path, text).unwrap();
        read_roles(&path, &odd)
    };
    let json = r#"{"left_upper_arm": "LeftOber", "right_upper_arm": "x:RightOber", "left_toes": ""}"#;
    let toml = "left_upper_arm = \"LeftOber\"\nright_upper_arm = \"RightOber\"\nleft_toes = \"\"\n";
    let roles = read(json).unwrap();
    roles.check(&odd).unwrap();
    assert_eq!(read(toml).unwrap(), roles);
    let name = |role| roles.get(role).map(|bone| odd.bones[bone].name.as_str());
    assert_eq!((name(Role::Pelvis), name(Role::Spine)), (Some("A"), Some("B")));
    assert_eq!((name(Role::LeftToes), name(Role::RightToes)), (None, Some("RightToe")));
    for (text, expected) in [
        (r#"{"left_uper_arm": "LeftOber"}"#, "unknown role `left_uper_arm` (did you mean `left_upper_arm`"),
        (r#"{"left_upper_arm": "LeftOben"}"#, "left_upper_arm: no bone `LeftOben` in a.bvh (did you mean `LeftOber`"),
        ("{\"pelvis\": 3}", "expected a JSON or TOML object like {\"pelvis\": \"Hips\"}: invalid type"),
        (r#"{"pelvis": "A", "pelvis": "B"}"#, "role `pelvis` is given twice"),
        ("pelvis = \"A\"\npelvis = \"B\"\n", "duplicate key"),
        (&format!("{{{}}}", " ".repeat(70_000)), "more than 65536 bytes, too long for a file of bones"),
        ("[1, 2]", "expected a JSON or TOML object"),
    ] {
        let message = read(text).unwrap_err().to_string();
        assert!(message.contains(expected), "{message}\ndoes not contain\n{expected}");
    }
}
