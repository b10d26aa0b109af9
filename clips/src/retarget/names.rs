//! Finds the role of each bone: limbs by their names, the trunk by the skeleton's tree.
//!
//! Programs name the limbs in a few ways, so there is one table of synonyms for all of them. They number the bones of
//! the trunk in more ways, but every skeleton has these between the legs, the arms and the head.

use std::collections::BTreeMap;
use std::fmt;
use std::io::Read as _;
use std::path::Path;

use serde::de::{self, Deserialize, Deserializer, MapAccess, Visitor};

use super::recorded::Recorded;
use super::roles::{Role, Roles};
use crate::error::Error;
use crate::nearest;

/// Greatest length of a file of bones, bytes. All roles with long names have about 3,000.
const LONGEST: u64 = 1 << 16;
/// Share of bones that begin alike, above which the beginning ("Bip01 ", "mixamorig_") is not part of the names.
const COMMON: f64 = 0.6;

/// A limb's role on the left and the right, and its names without the side: lower case, without separators.
///
/// A bone has one role. Rows and names are in the order in which bones are taken: for instance "shoulder" is an upper
/// arm in skeletons of joints ("shoulder, elbow, wrist"), but a collarbone where another bone is called "arm". SMPL's
/// joint "ankle" begins the foot, and its joint "foot" begins the toes.
const LIMBS: [([Role; 2], &[&str]); 9] = [
    (
        [Role::LeftForearm, Role::RightForearm],
        &["forearm", "lowerarm", "lowarm", "farm", "forearmbend", "radius", "elbow"],
    ),
    (
        [Role::LeftUpperArm, Role::RightUpperArm],
        &["upperarm", "uparm", "uarm", "humerus", "arm", "shldr", "shldrbend", "shoulder"],
    ),
    ([Role::LeftClavicle, Role::RightClavicle], &["clavicle", "collar", "collarbone", "shoulder"]),
    ([Role::LeftHand, Role::RightHand], &HAND),
    (
        [Role::LeftFingers, Role::RightFingers],
        &[
            "fingers",
            "fingerbase",
            "handmiddle1",
            "middle1",
            "middle01",
            "handindex1",
            "index1",
            "index01",
            "finger2",
            "finger1",
        ],
    ),
    ([Role::LeftShin, Role::RightShin], &["shin", "calf", "lowerleg", "lowleg", "tibia", "knee", "leg"]),
    ([Role::LeftThigh, Role::RightThigh], &["thigh", "thighbend", "upleg", "upperleg", "femur", "hip", "leg"]),
    ([Role::LeftFoot, Role::RightFoot], &["ankle", "foot"]),
    ([Role::LeftToes, Role::RightToes], &["toebase", "toes", "toe", "toe0", "ball", "foot"]),
];
/// Names of the hand.
const HAND: [&str; 2] = ["wrist", "hand"];
/// Names of the head.
const HEAD: [&str; 1] = ["head"];
/// Names of the neck where the skeleton has no head.
const NECK: [&str; 4] = ["neck", "neck1", "neck01", "lowerneck"];

/// The roles that names and tree show. Roles that they do not show have no bone; see [`Roles::check`].
pub fn find_roles(recorded: &Recorded) -> Roles {
    Search::new(recorded).finish()
}

/// Like [`find_roles`], with the roles of a file: a JSON or TOML object of roles ([`Role::name`]) and names of bones,
/// for instance `{"pelvis": "Hips", "left_thigh": "LeftUpLeg"}`. An empty name leaves the role without a bone.
///
/// # Errors
/// [`Error::Unreadable`]; [`Error::Recording`] if the file is not such an object, or if it has an unknown role or bone,
/// or a role twice.
pub fn read_roles(path: &Path, recorded: &Recorded) -> Result<Roles, Error> {
    let unreadable = |reason| Error::Unreadable { path: path.into(), reason };
    let wrong = |reason: String| Error::Recording { path: path.into(), reason };
    let mut text = String::new();
    let file = std::fs::File::open(path).map_err(unreadable)?;
    let length = file.take(LONGEST + 1).read_to_string(&mut text).map_err(unreadable)?;
    if length as u64 > LONGEST {
        return Err(wrong(format!("more than {LONGEST} bytes, too long for a file of bones")));
    }
    let expected = "expected a JSON or TOML object like {\"pelvis\": \"Hips\"}";
    let read: Result<Given, String> = match text.trim_start().starts_with('{') {
        true => serde_json::from_str(&text).map_err(|error| error.to_string()),
        false => toml::from_str(&text).map_err(|error| error.to_string()),
    };
    let Given(given) = read.map_err(|error| wrong(format!("{expected}: {}", error.trim_end())))?;
    let mut search = Search::new(recorded);
    for (role, bone) in given {
        let known: Vec<&str> = Role::all().map(Role::name).collect();
        let Some(role) = Role::from_name(&role) else {
            let hint = nearest::hint(&role, known.iter().copied());
            return Err(wrong(format!("unknown role `{role}`{hint}; roles are {}", known.join(", "))));
        };
        let bones = || recorded.bones.iter().map(|bone| bone.name.as_str());
        let own = bone.rsplit([':', '|']).next().unwrap_or_default();
        match bones().position(|name| name == own) {
            Some(index) => search.give(role, index),
            None if bone.is_empty() => search.refused.push(role),
            None => {
                let (hint, names) = (nearest::hint(own, bones()), bones().take(60).collect::<Vec<&str>>().join(", "));
                let recording = recorded.path.display();
                return Err(wrong(format!(
                    "{}: no bone `{bone}` in {recording}{hint}; its bones are {names}",
                    role.name()
                )));
            }
        }
    }
    Ok(search.finish())
}

/// The names of roles and bones in a file. A role that occurs twice is an error, because one of the two would be lost.
struct Given(BTreeMap<String, String>);

impl<'de> Deserialize<'de> for Given {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Pairs;

        impl<'de> Visitor<'de> for Pairs {
            type Value = Given;

            fn expecting(&self, formatter: &mut fmt::Formatter) -> fmt::Result {
                formatter.write_str("names of roles with names of bones")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Given, A::Error> {
                let mut given = BTreeMap::new();
                while let Some((role, bone)) = map.next_entry::<String, String>()? {
                    if given.contains_key(&role) {
                        return Err(de::Error::custom(format!("role `{role}` is given twice")));
                    }
                    given.insert(role, bone);
                }
                Ok(Given(given))
            }
        }

        deserializer.deserialize_map(Pairs)
    }
}

/// Roles and bones that are still to be matched.
struct Search<'a> {
    recorded: &'a Recorded,
    /// The names of the bones in lower case, without a common beginning and without separators.
    names: Vec<String>,
    roles: Roles,
    /// Whether the bone has a role.
    taken: Vec<bool>,
    /// Roles that stay without a bone.
    refused: Vec<Role>,
}

impl<'a> Search<'a> {
    fn new(recorded: &'a Recorded) -> Self {
        let mut names: Vec<&str> = recorded.bones.iter().map(|bone| bone.name.as_str()).collect();
        while strip_common(&mut names) {}
        let compact = |name: &&str| name.chars().filter(char::is_ascii_alphanumeric).collect::<String>();
        let names = names.iter().map(compact).map(|name| name.to_ascii_lowercase()).collect();
        Self { recorded, names, roles: Roles::new(), taken: vec![false; recorded.bones.len()], refused: Vec::new() }
    }

    fn give(&mut self, role: Role, bone: usize) {
        self.roles.set(role, bone);
        if let Some(taken) = self.taken.get_mut(bone) {
            *taken = true;
        }
    }

    /// Gives the role to a bone if both are free.
    fn offer(&mut self, role: Role, bone: Option<usize>) {
        if let Some(bone) = bone
            && self.taken.get(bone) == Some(&false)
            && self.roles.get(role).is_none()
            && !self.refused.contains(&role)
        {
            self.give(role, bone);
        }
    }

    /// The free bone with the first possible of these names. `own` removes the side from a name.
    fn named(&self, synonyms: &[&str], own: impl Fn(&str, &str) -> bool) -> Option<usize> {
        let free = |synonym: &&str| {
            let mut bones = self.names.iter().zip(&self.taken);
            bones.position(|(name, taken)| !taken && own(name, synonym))
        };
        synonyms.iter().find_map(free)
    }

    /// The hand. CMU's bone "wrist" is a part of the forearm, and its "hand" carries the fingers. SMPL's joint "hand" is
    /// in the palm, and carries nothing.
    fn hand(&self, own: impl Fn(&str, &str) -> bool) -> Option<usize> {
        let carries = |bone: &usize| self.recorded.bones.iter().any(|other| other.parent == Some(*bone));
        let [_, hand] = HAND;
        self.named(&[hand], &own).filter(carries).or_else(|| self.named(&HAND, own))
    }

    fn finish(mut self) -> Roles {
        for (roles, synonyms) in LIMBS {
            for (role, side) in roles.into_iter().zip([["left", "l"], ["right", "r"]]) {
                let own = |name: &str, synonym: &str| is_on_side(name, side, synonym);
                let bone = match role {
                    Role::LeftHand | Role::RightHand => self.hand(own),
                    _ => self.named(synonyms, own),
                };
                self.offer(role, bone);
            }
        }
        let head = self.named(&HEAD, |name, synonym| name == synonym);
        self.offer(Role::Head, head);
        self.trunk();
        if self.roles.get(Role::Head).is_none() {
            let neck = self.named(&NECK, |name, synonym| name == synonym);
            self.offer(Role::Neck, neck);
        }
        self.roles
    }

    /// Gives the roles of pelvis, spine and neck.
    fn trunk(&mut self) {
        let bone = |role| self.roles.get(role);
        let arms = [[Role::LeftClavicle, Role::LeftUpperArm], [Role::RightClavicle, Role::RightUpperArm]];
        let arms: Option<Vec<usize>> = arms.iter().map(|[first, second]| bone(*first).or(bone(*second))).collect();
        let (Some(arms), Some(left), Some(right)) = (arms, bone(Role::LeftThigh), bone(Role::RightThigh)) else {
            return;
        };
        let [mut carrier, above] = [self.common(arms.clone()), self.common(arms.into_iter().chain([left, right]))];
        let pelvis = bone(Role::Pelvis).or(above);
        self.offer(Role::Pelvis, pelvis);

        // In 3ds Max's bipeds the neck carries the arms.
        let is_neck = |bone: usize| self.names.get(bone).is_some_and(|name| name.starts_with("neck"));
        while let Some(neck) = carrier.filter(|bone| is_neck(*bone)) {
            carrier = self.parent(neck);
        }
        if let Some(head) = self.roles.get(Role::Head) {
            let neck = self.between(carrier, self.parent(head));
            self.offer(Role::Neck, neck.first().copied());
            self.offer(Role::UpperNeck, neck.last().copied());
        }
        let spine = self.between(pelvis, carrier);
        self.offer(Role::Spine, spine.first().copied());
        if let [_, .., last] = spine.as_slice() {
            let role = if spine.len() == 2 { Role::Chest } else { Role::UpperChest };
            self.offer(role, Some(*last));
            self.offer(Role::Chest, spine.get(spine.len() / 2).copied());
        }
    }

    fn parent(&self, bone: usize) -> Option<usize> {
        // Parents come before their children.
        self.recorded.bones.get(bone)?.parent.filter(|parent| *parent < bone)
    }

    /// The bone and its ancestors, the root last.
    fn line(&self, bone: Option<usize>) -> impl Iterator<Item = usize> {
        std::iter::successors(bone, |bone| self.parent(*bone))
    }

    /// The nearest bone that carries all of these without being one of them.
    fn common(&self, bones: impl IntoIterator<Item = usize>) -> Option<usize> {
        let lines: Vec<Vec<usize>> = bones.into_iter().map(|bone| self.line(self.parent(bone)).collect()).collect();
        let (first, others) = lines.split_first()?;
        first.iter().copied().find(|bone| others.iter().all(|line| line.contains(bone)))
    }

    /// The bones below `top` down to `bottom`; none if `bottom` is not below `top`.
    fn between(&self, top: Option<usize>, bottom: Option<usize>) -> Vec<usize> {
        let mut line: Vec<usize> = self.line(bottom).take_while(|bone| Some(*bone) != top).collect();
        let reached = line.last().is_some_and(|last| self.parent(*last) == top);
        if !reached || top.is_none() {
            return Vec::new();
        }
        line.reverse();
        line
    }
}

/// Whether the name is the synonym with the side before or after it.
fn is_on_side(name: &str, side: [&str; 2], synonym: &str) -> bool {
    let own = |side: &str| name.strip_prefix(side) == Some(synonym) || name.strip_suffix(side) == Some(synonym);
    side.into_iter().any(own)
}

/// Removes the beginning up to a separator that most names share. Returns whether there was one.
fn strip_common(names: &mut [&str]) -> bool {
    let start = |name: &str| name.find(['_', ' ', '-', '.']).map(|end| end + 1);
    let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
    for name in names.iter() {
        if let Some(beginning) = start(name).and_then(|end| name.get(..end)) {
            *counts.entry(beginning).or_default() += 1;
        }
    }
    let Some((common, count)) = counts.into_iter().max_by_key(|(_, count)| *count) else { return false };
    if (count as f64) <= COMMON * names.len() as f64 {
        return false;
    }
    for name in names.iter_mut() {
        *name = name.strip_prefix(common).unwrap_or(name);
    }
    true
}

#[cfg(test)]
mod tests;
