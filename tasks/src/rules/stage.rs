//! A simulation of the V2020 humanoid in an arena, for all tasks but tracking, and the contacts in it.

use std::sync::Arc;

use comic_clips::WalkerModel;
use mujoco_rs::prelude::*;

use crate::arenas::corridor::GROUND;
use crate::arenas::floor::BALL;
use crate::error::{Error, missing};
use crate::humanoid::PREFIX;
use crate::humanoid::observation::Body;
use crate::humanoid::walker::Walker;
use crate::physics::{Data, Models};

/// Physics steps in a control step of `CONTROL_TIMESTEP`.
pub(crate) const SUBSTEPS: usize = 6;

/// The kind of a geom, for the rules.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Part {
    /// The floor, or a platform.
    Ground,
    /// A foot or its toes. They may touch the ground (`walkers/cmu_humanoid.py`, `ground_contact_geoms`).
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
    /// Whether it is a part of the humanoid other than a foot.
    pub(crate) fn is_body(self) -> bool {
        match self {
            Self::Head | Self::Torso | Self::LeftHand | Self::RightHand | Self::Body => true,
            Self::Ground | Self::Foot | Self::Ball | Self::Other => false,
        }
    }
}

/// A compiled arena with the humanoid. All simulations in this arena share it.
#[derive(Debug)]
pub(crate) struct Arena {
    pub(crate) models: Models,
    pub(crate) walker: Walker,
    /// The part of each geom.
    parts: Vec<Part>,
    /// Bodies of the left and the right hand.
    pub(crate) hands: [usize; 2],
    /// Body of the ball, if there is a ball.
    pub(crate) ball: Option<usize>,
    /// Where each gap or wall of a corridor ends, m along the corridor; empty in other arenas.
    pub(crate) obstacle_ends: Vec<f64>,
}

impl Arena {
    pub(crate) fn new(model: MjModel) -> Result<Self, Error> {
        let walker = Walker::new(WalkerModel::Cmu2020, &model)?;
        let body = |name: &str| model.name_to_id(MjtObjBase::mjOBJ_BODY, name);
        let hand = |name: &str| body(&format!("{PREFIX}{name}")).ok_or_else(|| missing("body", name));
        let (hands, ball) = ([hand("lhand")?, hand("rhand")?], body(BALL));
        let parts = parts(&model);
        Ok(Self { models: Models::new(model, SUBSTEPS), walker, parts, hands, ball, obstacle_ends: Vec::new() })
    }

    /// With obstacles that end at these places, m along the corridor.
    pub(crate) fn with_obstacles(self, obstacle_ends: Vec<f64>) -> Self {
        Self { obstacle_ends, ..self }
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
            // The first geom of every arena is the ground plane.
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

    /// Moves the simulation to another arena. Arenas with the same memory layout share one allocation.
    pub(crate) fn enter(&mut self, arena: Arc<Arena>) {
        if !arena.models.take_over(&mut self.data) {
            self.data = arena.models.data();
        }
        self.arena = arena;
    }

    /// Sets the state and computes everything that follows from it without servo forces.
    pub(crate) fn place(&mut self, qpos: &[f64], qvel: &[f64]) {
        self.arena.models.place(&mut self.data, qpos, qvel, None);
    }

    pub(crate) fn step(&mut self, control: &[f64; 56]) {
        self.arena.models.step(&mut self.data, control);
    }

    /// The contacts at the end of the control step: both parts and the position, m.
    pub(crate) fn contacts(&self) -> impl Iterator<Item = (Part, Part, [f64; 3])> {
        let part = |geom: i32| usize::try_from(geom).ok().and_then(|geom| self.arena.parts.get(geom)).copied();
        self.data.contact().iter().filter_map(move |contact| {
            let [one, other] = contact.geom;
            Some((part(one)?, part(other)?, contact.pos))
        })
    }

    /// Positions of the contacts between the ground and a part of the humanoid other than a foot.
    pub(crate) fn falls(&self) -> impl Iterator<Item = [f64; 3]> {
        self.contacts().filter_map(|(one, other, place)| {
            let falls = (one == Part::Ground && other.is_body()) || (other == Part::Ground && one.is_body());
            falls.then_some(place)
        })
    }

    /// Whether there is such a contact.
    pub(crate) fn has_fallen(&self) -> bool {
        self.falls().next().is_some()
    }

    /// The humanoid, for observations.
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
