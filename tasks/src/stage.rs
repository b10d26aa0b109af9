//! What every task but tracking is played on: the V2020 humanoid in an arena, and who touches whom there.

use std::sync::Arc;

use comic_clips::WalkerModel;
use mujoco_rs::prelude::*;

use crate::arenas::corridor::GROUND;
use crate::arenas::floor::BALL;
use crate::error::Error;
use crate::humanoid::{PREFIX, missing};
use crate::observation::Body;
use crate::physics::{Data, Models};
use crate::walker::Walker;

/// Physics steps in a control step of 0.03 s (S).
pub(crate) const SUBSTEPS: usize = 6;
/// Seconds of a control step.
pub(crate) const CONTROL_TIMESTEP: f64 = 0.03;

/// What a geom is to the rules of the tasks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Part {
    /// The floor, or a platform.
    Ground,
    /// A foot or its toes, which may touch the ground (`walkers/cmu_humanoid.py`, `ground_contact_geoms`).
    Foot,
    Head,
    Torso,
    LeftHand,
    RightHand,
    /// Any other part of the humanoid.
    Body,
    Ball,
    /// Walls, sides.
    Other,
}

impl Part {
    /// Whether it belongs to the humanoid and is no foot.
    pub(crate) fn is_body(self) -> bool {
        matches!(self, Self::Head | Self::Torso | Self::LeftHand | Self::RightHand | Self::Body)
    }
}

/// A compiled arena with the humanoid in it, shared by all simulations in it.
#[derive(Debug)]
pub(crate) struct Arena {
    pub(crate) models: Models,
    pub(crate) walker: Walker,
    /// By geom.
    parts: Vec<Part>,
    /// Bodies of the left and the right hand.
    pub(crate) hands: [usize; 2],
    /// Body of the ball, where there is one.
    pub(crate) ball: Option<usize>,
}

impl Arena {
    pub(crate) fn new(model: MjModel) -> Result<Self, Error> {
        let walker = Walker::new(WalkerModel::Cmu2020, &model)?;
        let body = |name: &str| model.name_to_id(MjtObjBase::mjOBJ_BODY, name);
        let hand = |name: &str| body(&format!("{PREFIX}{name}")).ok_or_else(|| missing("body", name));
        let (hands, ball) = ([hand("lhand")?, hand("rhand")?], body(BALL));
        let parts = parts(&model);
        Ok(Self { models: Models::new(model, SUBSTEPS), walker, parts, hands, ball })
    }
}

fn parts(model: &MjModel) -> Vec<Part> {
    let part = |(geom, body): (usize, &i32)| {
        let body = usize::try_from(*body).ok().and_then(|body| model.id_to_name(MjtObjBase::mjOBJ_BODY, body));
        let body = body.unwrap_or_default();
        match body.strip_prefix(PREFIX) {
            Some("lfoot" | "ltoes" | "rfoot" | "rtoes") => Part::Foot,
            Some("head" | "face") => Part::Head,
            Some("root" | "lowerback" | "upperback" | "thorax") => Part::Torso,
            Some("lhand" | "lfingers" | "lthumb") => Part::LeftHand,
            Some("rhand" | "rfingers" | "rthumb") => Part::RightHand,
            Some(_) => Part::Body,
            // Every arena's first geom is the plane it stands on.
            None if body == GROUND || geom == 0 => Part::Ground,
            None if body == BALL => Part::Ball,
            None => Part::Other,
        }
    };
    model.geom_bodyid().iter().enumerate().map(part).collect()
}

/// One simulation in an arena.
#[derive(Debug)]
pub(crate) struct Stage {
    pub(crate) arena: Arc<Arena>,
    pub(crate) data: Data,
}

impl Stage {
    pub(crate) fn new(arena: Arc<Arena>) -> Self {
        let data = arena.models.data();
        Self { arena, data }
    }

    /// Goes to another arena, keeping the simulation's memory where the two are laid out alike.
    pub(crate) fn enter(&mut self, arena: Arc<Arena>) {
        if !arena.models.take_over(&mut self.data) {
            self.data = arena.models.data();
        }
        self.arena = arena;
    }

    /// Puts everything into this state and computes what follows from it, without servo forces.
    pub(crate) fn place(&mut self, qpos: &[f64], qvel: &[f64]) {
        self.arena.models.place(&mut self.data, qpos, qvel, None);
    }

    pub(crate) fn step(&mut self, control: &[f64; 56]) {
        self.arena.models.step(&mut self.data, control);
    }

    /// What touches what at the end of the control step: both parts and the place, m.
    pub(crate) fn contacts(&self) -> impl Iterator<Item = (Part, Part, [f64; 3])> {
        let part = |geom: i32| usize::try_from(geom).ok().and_then(|geom| self.arena.parts.get(geom)).copied();
        self.data.contact().iter().filter_map(move |contact| {
            let [one, other] = contact.geom;
            Some((part(one)?, part(other)?, contact.pos))
        })
    }

    /// Contacts between the ground and a part of the humanoid that is no foot.
    pub(crate) fn falls(&self) -> impl Iterator<Item = [f64; 3]> {
        self.contacts().filter_map(|(one, other, place)| {
            let falls = (one == Part::Ground && other.is_body()) || (other == Part::Ground && one.is_body());
            falls.then_some(place)
        })
    }

    /// Whether there is one.
    pub(crate) fn has_fallen(&self) -> bool {
        self.falls().next().is_some()
    }

    /// The humanoid, to observe.
    pub(crate) fn body(&self) -> Body<'_> {
        Body { walker: &self.arena.walker, data: &self.data }
    }

    /// Position (m, world) and rotation matrix of the root.
    pub(crate) fn root(&self) -> (&[f64; 3], &[f64; 9]) {
        let root = self.arena.walker.root;
        (&self.data.xpos()[root], &self.data.xmat()[root])
    }

    /// Height of the head, m.
    pub(crate) fn head_height(&self) -> f64 {
        self.arena.walker.head_height(&self.data)
    }
}
