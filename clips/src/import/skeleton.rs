//! The moving bones of CMU's skeletons, and their joints in the V2020 body.

use crate::humanoid::JOINTS;

/// A bone and its angles in an AMC file, in the order of its `dof` line.
///
/// The V2020 body was modelled on this skeleton. At zero angles its frames are the axes of the bones, and its hinges
/// turn in the order z, y, x, like the angles of an AMC file. So an angle of the file is the angle of a joint, with the
/// same sign.
pub(super) struct Bone {
    pub(super) name: &'static str,
    pub(super) dofs: &'static [&'static str],
}

const XYZ: &[&str] = &["rx", "ry", "rz"];
const X: &[&str] = &["rx"];
const XZ: &[&str] = &["rx", "rz"];

/// The moving bones, the same in every ASF file of the database.
#[rustfmt::skip]
pub(super) const BONES: [Bone; 28] = [
    bone("lowerback", XYZ), bone("upperback", XYZ), bone("thorax", XYZ), bone("lowerneck", XYZ),
    bone("upperneck", XYZ), bone("head", XYZ),
    bone("lclavicle", &["ry", "rz"]), bone("lhumerus", XYZ), bone("lradius", X), bone("lwrist", &["ry"]),
    bone("lhand", XZ), bone("lfingers", X), bone("lthumb", XZ),
    bone("rclavicle", &["ry", "rz"]), bone("rhumerus", XYZ), bone("rradius", X), bone("rwrist", &["ry"]),
    bone("rhand", XZ), bone("rfingers", X), bone("rthumb", XZ),
    bone("lfemur", XYZ), bone("ltibia", X), bone("lfoot", XZ), bone("ltoes", X),
    bone("rfemur", XYZ), bone("rtibia", X), bone("rfoot", XZ), bone("rtoes", X),
];

const fn bone(name: &'static str, dofs: &'static [&'static str]) -> Bone {
    Bone { name, dofs }
}

impl Bone {
    pub(super) fn find(name: &str) -> Option<&'static Self> {
        BONES.iter().find(|bone| bone.name == name)
    }

    /// The indices of its angles in [`JOINTS`].
    pub(super) fn joints(&self) -> impl Iterator<Item = usize> {
        // The body has a hinge for every angle; a test checks that.
        self.dofs.iter().filter_map(|dof| JOINTS.iter().position(|joint| joint.strip_prefix(self.name) == Some(dof)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_hinge_of_the_body_is_one_angle_of_a_bone() {
        let mut joints: Vec<usize> = BONES.iter().flat_map(Bone::joints).collect();
        joints.sort_unstable();
        assert_eq!(joints, (0..56).collect::<Vec<_>>());
    }
}
