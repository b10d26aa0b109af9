//! Draws an environment for people: the humanoid from outside or with its own camera, and the reference as a ghost.
//!
//! Drawing needs OpenGL through EGL, and no display. A film's OpenGL context belongs to the thread that made the film. The
//! policy's camera images (`vision`) may be drawn in the same thread: both make their context current before they draw.

use std::str::FromStr;
use std::sync::Arc;

use mujoco_rs::prelude::*;
use mujoco_rs::renderer::MjRenderer;

use super::ghost::{Ghost, GhostBody};
use super::vision::{egocentric, graphics};
use crate::arenas::floor::TARGET;
use crate::environment::{Scenery, Simulated};
use crate::error::{Error, missing};
use crate::humanoid::PREFIX;
use crate::physics::Simulation;

/// Width of the shadow map in pixels, and samples per pixel. The shadow map has half the width of dm_control's, which
/// takes a quarter of the time in software.
const SHADOW_SIZE: i32 = 2048;
const SAMPLES: i32 = 4;
/// Distance of the outside cameras from the humanoid's centre of mass (m), and their angle to the horizontal (degrees).
const DISTANCE: f64 = 3.8;
const ELEVATION: f64 = -14.0;
/// Angles from the humanoid's heading at the start of the episode to the direction of the cameras (degrees): over its right
/// shoulder, and from its right.
const TRACKING_TURN: f64 = 35.0;
const SIDE_TURN: f64 = 90.0;

/// The camera.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Camera {
    /// Behind the humanoid's right shoulder. It follows the centre of mass.
    #[default]
    Tracking,
    /// The humanoid's egocentric camera.
    Egocentric,
    /// At the humanoid's right. It follows the centre of mass.
    Side,
}

/// Width and height of a picture in pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Size {
    width: u16,
    height: u16,
}

impl Size {
    /// The smallest and largest value of both.
    const RANGE: std::ops::RangeInclusive<u16> = 16..=2048;

    /// A picture of `width` × `height` pixels; `None` unless both are within 16 … 2048.
    pub fn new(width: u16, height: u16) -> Option<Self> {
        (Self::RANGE.contains(&width) && Self::RANGE.contains(&height)).then_some(Self { width, height })
    }

    /// Width in pixels.
    pub fn width(self) -> u16 {
        self.width
    }

    /// Height in pixels.
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
        size.ok_or_else(|| {
            format!("`{text}` is not a size; give WIDTHxHEIGHT, both from 16 to 2048, for instance 640x480")
        })
    }
}

/// How a film is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shot {
    /// Size of every picture.
    pub size: Size,
    /// The camera.
    pub camera: Camera,
    /// The place of the ghost, in a task with a reference; `None` draws no ghost.
    pub ghost: Option<Ghost>,
}

/// Draws pictures of environments of one task.
#[derive(Debug)]
pub struct Film {
    shot: Shot,
    renderer: Option<OffscreenRenderer>,
    /// The humanoid's heading when the episode began, rad.
    heading: f64,
}

impl Film {
    /// A film without pictures. The first [`draw`](Self::draw) fails when there is no OpenGL.
    pub fn new(shot: Shot) -> Self {
        Self { shot, renderer: None, heading: 0.0 }
    }

    /// A picture of the environment after its last reset or step: [`Size::bytes`] bytes.
    ///
    /// # Errors
    /// [`Error::Graphics`]: there is no OpenGL.
    pub fn draw(&mut self, environment: &mut dyn Simulated) -> Result<&[u8], Error> {
        let (model, scenery) = (environment.model(), environment.scenery());
        let fits = |renderer: &OffscreenRenderer| renderer.context.scene().is_compatible_with_model(&model);
        let (renderer, opened) = match self.renderer.take().filter(fits) {
            Some(renderer) => (self.renderer.insert(renderer), false),
            None => (self.renderer.insert(OffscreenRenderer::new(&model, self.shot)?), true),
        };
        let simulation = environment.simulation_mut();
        if opened || simulation.time() == 0.0 {
            self.heading = renderer.heading(simulation);
        }
        renderer.draw(simulation, &scenery, self.shot, self.heading)
    }
}

/// An OpenGL context without a window, for models with one memory layout.
#[derive(Debug)]
struct OffscreenRenderer {
    context: MjRenderer,
    ghost: Option<GhostBody>,
    root: usize,
    /// The site of the target's mark, if there is one.
    target: Option<usize>,
}

impl OffscreenRenderer {
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
        // The model of a context decides its settings. It can draw any model with the same layout.
        let mut settings = MjModel::clone(model);
        let visual = settings.vis_mut();
        (visual.quality.shadowsize, visual.quality.offsamples) = (SHADOW_SIZE, SAMPLES);
        (visual.global.offwidth, visual.global.offheight) = (shot.size.width.into(), shot.size.height.into());
        let ghost = shot.ghost.map(|_| GhostBody::new(model));
        let context = MjRenderer::builder()
            .width(shot.size.width.into())
            .height(shot.size.height.into())
            .camera(camera)
            .opts(options)
            .num_visual_user_geom(ghost.as_ref().map_or(0, GhostBody::parts))
            .build(&settings)
            .map_err(graphics)?;
        Ok(Self { context, ghost, root, target: model.name_to_id(MjtObjBase::mjOBJ_SITE, TARGET) })
    }

    /// Angle about the vertical between +x and the root's forward axis, its own z, rad.
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
            self.context.camera_mut().azimuth = azimuth;
        }
        scenery.mark_target(self.target, simulation);
        if let (Some(body), Some(ghost), Some(reference)) = (&mut self.ghost, shot.ghost, &scenery.reference) {
            body.set_pose(reference, ghost, azimuth.to_radians());
            let options = self.context.opts().clone();
            body.draw(self.context.user_scene_mut(), &options);
        }
        self.context.sync_data(simulation).map_err(graphics)?;
        self.context.render().map_err(graphics)?;
        self.context.rgb_flat().ok_or_else(|| Error::Graphics { reason: "MuJoCo returned no picture".into() })
    }
}
