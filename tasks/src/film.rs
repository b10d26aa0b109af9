//! Drawing an environment for people: the humanoid from outside or through its own eyes, and a ghost of the reference.
//!
//! Drawing needs OpenGL through EGL, and no display. A film's context belongs to the thread that made the film. The
//! humanoid's own sight ([`vision`](crate::vision)) may draw in the same thread: each makes its context current before
//! it draws.

use std::str::FromStr;
use std::sync::Arc;

use mujoco_rs::prelude::*;
use mujoco_rs::renderer::MjRenderer;

use crate::arenas::floor::TARGET;
use crate::error::Error;
use crate::ghost::{Ghost, Phantom};
use crate::humanoid::{PREFIX, missing};
use crate::vision::{egocentric, graphics};
use crate::{Scenery, Simulated, Simulation};

/// Side of the shadow map in pixels, half of dm_control's (in software a quarter of the time), and samples a pixel.
const SHADOW_SIZE: i32 = 2048;
const SAMPLES: i32 = 4;
/// Distance of the cameras outside from the humanoid's centre of mass (m), and how far they look down (degrees).
const DISTANCE: f64 = 3.8;
const ELEVATION: f64 = -14.0;
/// Angles from the humanoid's heading at an episode's begin to where the cameras look (degrees): over its right
/// shoulder to what lies ahead, and from its right.
const TRACKING_TURN: f64 = 35.0;
const SIDE_TURN: f64 = 90.0;

/// Whence an environment is drawn.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Camera {
    /// From behind its right shoulder, following its centre of mass.
    #[default]
    Tracking,
    /// Through its own eyes.
    Egocentric,
    /// From its right, following its centre of mass.
    Side,
}

/// Width and height of a picture in pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Size {
    width: u16,
    height: u16,
}

impl Size {
    /// The least and the most of either.
    const RANGE: std::ops::RangeInclusive<u16> = 16..=2048;

    /// A picture of `width` × `height` pixels; `None` when either is not within 16 … 2048.
    pub fn new(width: u16, height: u16) -> Option<Self> {
        (Self::RANGE.contains(&width) && Self::RANGE.contains(&height)).then_some(Self { width, height })
    }

    /// Pixels from left to right.
    pub fn width(self) -> u16 {
        self.width
    }

    /// Pixels from top to bottom.
    pub fn height(self) -> u16 {
        self.height
    }

    /// Bytes of a picture: rows from the top, pixels from the left, red, green, blue.
    pub fn bytes(self) -> usize {
        3 * usize::from(self.width) * usize::from(self.height)
    }
}

impl FromStr for Size {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let size =
            text.split_once('x').and_then(|(width, height)| Self::new(width.parse().ok()?, height.parse().ok()?));
        size.ok_or_else(|| format!("`{text}` is no size: give WIDTHxHEIGHT with both within 16 and 2048, like 640x480"))
    }
}

/// How a film is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shot {
    /// Of every picture.
    pub size: Size,
    /// Whence.
    pub camera: Camera,
    /// Where the reference is drawn, in a task that has one.
    pub ghost: Option<Ghost>,
}

/// Draws environments of one task, one picture after the other.
#[derive(Debug)]
pub struct Film {
    shot: Shot,
    studio: Option<Studio>,
    /// The humanoid's heading when the episode began, rad.
    heading: f64,
}

impl Film {
    /// Nothing is drawn yet; the first [`draw`](Self::draw) says whether there is OpenGL.
    pub fn new(shot: Shot) -> Self {
        Self { shot, studio: None, heading: 0.0 }
    }

    /// A picture of the environment after its last reset or step: [`Size::bytes`] bytes.
    ///
    /// # Errors
    /// [`Error::Graphics`] when there is nothing to draw with.
    pub fn draw(&mut self, environment: &mut dyn Simulated) -> Result<&[u8], Error> {
        let (model, scenery) = (environment.model(), environment.scenery());
        let fits = |studio: &Studio| studio.renderer.scene().is_compatible_with_model(&model);
        let (studio, opened) = match self.studio.take().filter(fits) {
            Some(studio) => (self.studio.insert(studio), false),
            None => (self.studio.insert(Studio::new(&model, self.shot)?), true),
        };
        let simulation = environment.simulation_mut();
        if opened || simulation.time() == 0.0 {
            self.heading = studio.heading(simulation);
        }
        studio.draw(simulation, &scenery, self.shot, self.heading)
    }
}

/// An off-screen context for models of one layout, and what of them is drawn.
#[derive(Debug)]
struct Studio {
    renderer: MjRenderer,
    phantom: Option<Phantom>,
    root: usize,
    /// The site that marks a target, where there is one.
    target: Option<usize>,
}

impl Studio {
    fn new(model: &Arc<MjModel>, shot: Shot) -> Result<Self, Error> {
        let root = model
            .name_to_id(MjtObjBase::mjOBJ_BODY, &format!("{PREFIX}root"))
            .ok_or_else(|| missing("body", "root"))?;
        let (camera, options) = match shot.camera {
            Camera::Egocentric => egocentric(model)?,
            Camera::Tracking | Camera::Side => {
                let camera = MjvCamera { distance: DISTANCE, elevation: ELEVATION, ..MjvCamera::new_tracking(root) };
                (camera, MjvOption::default())
            }
        };
        // How a context draws is decided by the model it is made for; drawn is whatever model comes.
        let mut settings = MjModel::clone(model);
        let visual = settings.vis_mut();
        (visual.quality.shadowsize, visual.quality.offsamples) = (SHADOW_SIZE, SAMPLES);
        (visual.global.offwidth, visual.global.offheight) = (shot.size.width.into(), shot.size.height.into());
        let phantom = shot.ghost.map(|_| Phantom::new(model));
        let renderer = MjRenderer::builder()
            .width(shot.size.width.into())
            .height(shot.size.height.into())
            .camera(camera)
            .opts(options)
            .num_visual_user_geom(phantom.as_ref().map_or(0, Phantom::parts))
            .build(&settings)
            .map_err(graphics)?;
        Ok(Self { renderer, phantom, root, target: model.name_to_id(MjtObjBase::mjOBJ_SITE, TARGET) })
    }

    /// Angle about the vertical by which the root's forward axis, its own z, is turned from +x, rad.
    fn heading(&self, simulation: &Simulation) -> f64 {
        let rotation = &simulation.xmat()[self.root];
        rotation[5].atan2(rotation[2])
    }

    fn draw(
        &mut self,
        simulation: &mut Simulation,
        scenery: &Scenery,
        shot: Shot,
        heading: f64,
    ) -> Result<&[u8], Error> {
        let turn = match shot.camera {
            Camera::Tracking => TRACKING_TURN,
            Camera::Side | Camera::Egocentric => SIDE_TURN,
        };
        let azimuth = heading.to_degrees() + turn;
        if shot.camera != Camera::Egocentric {
            self.renderer.camera_mut().azimuth = azimuth;
        }
        scenery.mark_target(self.target, simulation);
        if let (Some(phantom), Some(ghost), Some(reference)) = (&mut self.phantom, shot.ghost, &scenery.reference) {
            phantom.stand(reference, ghost, azimuth.to_radians());
            let options = self.renderer.opts().clone();
            phantom.appear(self.renderer.user_scene_mut(), &options);
        }
        self.renderer.sync_data(simulation).map_err(graphics)?;
        self.renderer.render().map_err(graphics)?;
        self.renderer.rgb_flat().ok_or_else(|| Error::Graphics { reason: "nothing was drawn".into() })
    }
}
