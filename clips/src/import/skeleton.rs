//! The bones of CMU's skeletons that move, and what the V2020 body makes of them.

use crate::humanoid::JOINTS;

/// A bone and the angles an AMC file has of it, in the order of its `dof` line.
///
/// The V2020 body was modelled on this skeleton: at zero angles its frames are the bones' axes, and its hinges turn
/// z, y, x like the AMC's angles, so an angle is a joint's angle, sign and all.
pub(super) struct Bone {
    pub(super) name: &'static str,
    pub(super) dofs: &'static [&'static str],
}

const XYZ: &[&str] = &["rx", "ry", "rz"];
const X: &[&str] = &["rx"];
const XZ: &[&str] = &["rx", "rz"];

/// The same in every ASF file of the database.
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

    /// The places of its angles in [`JOINTS`].
    pub(super) fn joints(&self) -> impl Iterator<Item = usize> {
        // The body has a hinge for each, which a test holds.
        self.dofs.iter().filter_map(|dof| JOINTS.iter().position(|joint| joint.strip_prefix(self.name) == Some(dof)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bones_angles_are_the_bodys_hinges_each_once() {
        let mut joints: Vec<usize> = BONES.iter().flat_map(Bone::joints).collect();
        joints.sort_unstable();
        assert_eq!(joints, (0..56).collect::<Vec<_>>());
    }
}
