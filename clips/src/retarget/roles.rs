//! Which bone of a skeleton is which part of a person.

use super::recorded::Recorded;
use crate::error::Error;

/// A part of a person. A bone is named after the part that turns with it: the bone `LeftShin` begins at the knee.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Role {
    /// The bone that carries both legs and the spine.
    Pelvis,
    /// The first bone of the spine that turns against the pelvis.
    Spine,
    /// A bone in the middle of the spine; or the one that carries the arms, if there is no `UpperChest`.
    Chest,
    /// The bone that carries the collarbones, or the arms and the neck.
    UpperChest,
    /// The first bone of the neck.
    Neck,
    /// The second bone of the neck.
    UpperNeck,
    /// The head.
    Head,
    /// Collarbone, often named "shoulder": from the breastbone to the shoulder.
    LeftClavicle,
    /// From the shoulder to the elbow, often named "arm".
    LeftUpperArm,
    /// From the elbow to the wrist.
    LeftForearm,
    /// Begins at the wrist.
    LeftHand,
    /// The fingers without the thumb: one of them, or all.
    LeftFingers,
    /// From the hip joint to the knee, often named "up leg".
    LeftThigh,
    /// From the knee to the ankle, often named "leg".
    LeftShin,
    /// From the ankle to the ball of the foot.
    LeftFoot,
    /// Begins at the ball of the foot.
    LeftToes,
    /// See [`Role::LeftClavicle`].
    RightClavicle,
    /// See [`Role::LeftUpperArm`].
    RightUpperArm,
    /// See [`Role::LeftForearm`].
    RightForearm,
    /// See [`Role::LeftHand`].
    RightHand,
    /// See [`Role::LeftFingers`].
    RightFingers,
    /// See [`Role::LeftThigh`].
    RightThigh,
    /// See [`Role::LeftShin`].
    RightShin,
    /// See [`Role::LeftFoot`].
    RightFoot,
    /// See [`Role::LeftToes`].
    RightToes,
}

/// Every role with its name in files of bones.
const NAMES: [(Role, &str); Role::COUNT] = [
    (Role::Pelvis, "pelvis"),
    (Role::Spine, "spine"),
    (Role::Chest, "chest"),
    (Role::UpperChest, "upper_chest"),
    (Role::Neck, "neck"),
    (Role::UpperNeck, "upper_neck"),
    (Role::Head, "head"),
    (Role::LeftClavicle, "left_clavicle"),
    (Role::LeftUpperArm, "left_upper_arm"),
    (Role::LeftForearm, "left_forearm"),
    (Role::LeftHand, "left_hand"),
    (Role::LeftFingers, "left_fingers"),
    (Role::LeftThigh, "left_thigh"),
    (Role::LeftShin, "left_shin"),
    (Role::LeftFoot, "left_foot"),
    (Role::LeftToes, "left_toes"),
    (Role::RightClavicle, "right_clavicle"),
    (Role::RightUpperArm, "right_upper_arm"),
    (Role::RightForearm, "right_forearm"),
    (Role::RightHand, "right_hand"),
    (Role::RightFingers, "right_fingers"),
    (Role::RightThigh, "right_thigh"),
    (Role::RightShin, "right_shin"),
    (Role::RightFoot, "right_foot"),
    (Role::RightToes, "right_toes"),
];

/// The roles that every skeleton must have, apart from head or neck, and from the ends of the forearms.
const REQUIRED: [Role; 11] = [
    Role::Pelvis,
    Role::LeftThigh,
    Role::LeftShin,
    Role::LeftFoot,
    Role::RightThigh,
    Role::RightShin,
    Role::RightFoot,
    Role::LeftUpperArm,
    Role::LeftForearm,
    Role::RightUpperArm,
    Role::RightForearm,
];

impl Role {
    /// The number of roles.
    pub const COUNT: usize = 25;

    /// All roles, from the pelvis outwards.
    pub fn all() -> impl Iterator<Item = Self> {
        NAMES.iter().map(|(role, _)| *role)
    }

    /// The name in files of bones, for example `left_upper_arm`.
    pub fn name(self) -> &'static str {
        NAMES.get(self as usize).map_or("", |(_, name)| *name)
    }

    /// The role with this name.
    pub fn from_name(name: &str) -> Option<Self> {
        NAMES.iter().find(|(_, own)| *own == name).map(|(role, _)| *role)
    }
}

/// The bone of each role in one [`Recorded`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Roles {
    bones: [Option<usize>; Role::COUNT],
}

impl Roles {
    /// Nothing is known yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// Gives the role to the bone with this index in [`Recorded::bones`].
    pub fn set(&mut self, role: Role, bone: usize) {
        self.bones[role as usize] = Some(bone);
    }

    /// The index of the bone that has the role.
    pub fn get(&self, role: Role) -> Option<usize> {
        self.bones[role as usize]
    }

    /// The optional roles without a bone that change the result. Fingers move little, and many skeletons have one bone of
    /// the neck and fewer than three of the spine.
    pub(super) fn missing(&self) -> Vec<&'static str> {
        let has = |role: Role| self.get(role).is_some();
        let spine = [Role::Spine, Role::Chest, Role::UpperChest].into_iter().any(has);
        let mut missing = if spine { Vec::new() } else { vec![Role::Spine.name()] };
        let others = [
            Role::Neck,
            Role::Head,
            Role::LeftClavicle,
            Role::RightClavicle,
            Role::LeftHand,
            Role::RightHand,
            Role::LeftToes,
            Role::RightToes,
        ];
        missing.extend(others.into_iter().filter(|role| !has(*role)).map(Role::name));
        missing
    }

    /// Checks that the required roles have different bones of `recorded`, each below its parent. Required are the
    /// pelvis; thighs, shins and feet; upper arms and forearms; hands, or forearms that say where they end; head or
    /// neck.
    ///
    /// # Errors
    /// [`Error::Recording`] names the roles and the remedy.
    pub fn check(&self, recorded: &Recorded) -> Result<(), Error> {
        let refuse = |reason: String| {
            let reason = format!("{reason}; say which bone has which role with --bones FILE");
            Err(Error::Recording { path: recorded.path.clone(), reason })
        };
        let mut missing: Vec<&str> =
            REQUIRED.into_iter().filter(|role| self.get(*role).is_none()).map(Role::name).collect();
        for (hand, forearm) in [(Role::LeftHand, Role::LeftForearm), (Role::RightHand, Role::RightForearm)] {
            let end = self.get(forearm).and_then(|bone| recorded.bones.get(bone)).and_then(|bone| bone.end);
            if self.get(hand).is_none() && end.is_none() {
                missing.push(hand.name());
            }
        }
        if self.get(Role::Head).is_none() && self.get(Role::Neck).is_none() {
            missing.push("head or neck");
        }
        if !missing.is_empty() {
            let bones: Vec<&str> = recorded.bones.iter().take(60).map(|bone| bone.name.as_str()).collect();
            return refuse(format!(
                "no bone is known to be {}; its bones are {}",
                missing.join(", "),
                bones.join(", ")
            ));
        }
        for role in Role::all() {
            let Some(bone) = self.get(role) else { continue };
            let Some(own) = recorded.bones.get(bone) else {
                return refuse(format!("{} is bone {bone}, but it has {} bones", role.name(), recorded.bones.len()));
            };
            if let Some(other) = Role::all().find(|other| *other < role && self.get(*other) == Some(bone)) {
                return refuse(format!("bone `{}` is both {} and {}", own.name, other.name(), role.name()));
            }
        }
        for [parent, child] in CHAINS {
            if let (Some(above), Some(below)) = (self.get(parent), self.get(child))
                && !is_below(recorded, below, above)
            {
                return refuse(format!("{} is not below {} in its skeleton", child.name(), parent.name()));
            }
        }
        Ok(())
    }
}

/// Pairs of roles of which the second turns with the first.
const CHAINS: [[Role; 2]; 14] = [
    [Role::Pelvis, Role::LeftThigh],
    [Role::LeftThigh, Role::LeftShin],
    [Role::LeftShin, Role::LeftFoot],
    [Role::LeftFoot, Role::LeftToes],
    [Role::Pelvis, Role::RightThigh],
    [Role::RightThigh, Role::RightShin],
    [Role::RightShin, Role::RightFoot],
    [Role::RightFoot, Role::RightToes],
    [Role::LeftUpperArm, Role::LeftForearm],
    [Role::LeftForearm, Role::LeftHand],
    [Role::RightUpperArm, Role::RightForearm],
    [Role::RightForearm, Role::RightHand],
    [Role::LeftHand, Role::LeftFingers],
    [Role::RightHand, Role::RightFingers],
];

/// Whether `bone` is a descendant of `ancestor`. Parents come before their children, so the search ends.
fn is_below(recorded: &Recorded, bone: usize, ancestor: usize) -> bool {
    let mut at = bone;
    while let Some(parent) = recorded.bones.get(at).and_then(|bone| bone.parent).filter(|parent| *parent < at) {
        if parent == ancestor {
            return true;
        }
        at = parent;
    }
    false
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_in_the_order_of_the_roles() {
        for (place, role) in Role::all().enumerate() {
            assert_eq!(role as usize, place);
            assert_eq!(Role::from_name(role.name()), Some(role));
        }
    }
}
