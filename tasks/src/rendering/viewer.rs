//! A window that shows an environment: mujoco-rs's viewer. Feature `viewer`.
//!
//! The window belongs to the process's first thread. Its OpenGL context does not allow a context for camera images in the
//! same thread. So environments step in another thread, and a [`Screen`] shows them.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use mujoco_rs::prelude::*;
use mujoco_rs::viewer::{MjViewer, MjViewerError, ViewerSharedState};

use super::ghost::{Ghost, GhostBody};
use crate::arenas::floor::TARGET;
use crate::environment::Simulated;
use crate::error::Error;
use crate::humanoid::PREFIX;
use crate::physics::Simulation;

/// The first view: its extent (m), and the camera's angle to the horizontal (degrees). MuJoCo places the camera at one
/// and a half times the extent.
const EXTENT: f64 = 2.5;
const ELEVATION: f32 = -14.0;
/// The camera's first direction (rad, from +x): MuJoCo's default.
const AZIMUTH: f64 = std::f64::consts::FRAC_PI_2;
/// The shortest time between two pictures: 60 per second.
const PICTURE_TIME: Duration = Duration::from_micros(16_667);

/// The window. It belongs to the process's first thread.
#[derive(Debug)]
pub struct Viewer {
    window: MjViewer,
}

/// Shows environments in the window, from any thread.
#[derive(Debug)]
pub struct Screen {
    state: Arc<Mutex<ViewerSharedState>>,
    ghost: Option<Ghost>,
    ghost_body: Option<GhostBody>,
    model: Arc<MjModel>,
}

impl Viewer {
    /// Opens a window for environments like this one.
    ///
    /// # Errors
    /// [`Error::Display`]: there is no display, or it has no OpenGL.
    pub fn open(environment: &dyn Simulated, ghost: Option<Ghost>) -> Result<(Self, Screen), Error> {
        // This check comes first because its message names the variables.
        if ["DISPLAY", "WAYLAND_DISPLAY"].iter().all(|name| std::env::var_os(name).is_none_or(|name| name.is_empty())) {
            return Err(Error::Display { reason: "neither DISPLAY nor WAYLAND_DISPLAY is set".into() });
        }
        let model = environment.model();
        let ghost_body = ghost.map(|_| GhostBody::new(&model));
        let parts = ghost_body.as_ref().map_or(0, GhostBody::parts) as usize;
        let settings = near_the_humanoid(&model, environment.simulation());
        let window =
            MjViewer::builder().window_name("CoMic").max_user_geoms(parts).build_passive(&settings).map_err(display)?;
        let screen = Screen { state: Arc::clone(window.state()), ghost, ghost_body, model };
        Ok((Self { window }, screen))
    }

    /// Draws until the window is closed or `keep_running` returns false.
    ///
    /// # Errors
    /// [`Error::Display`]: OpenGL fails.
    pub fn run(&mut self, keep_running: impl Fn() -> bool) -> Result<(), Error> {
        while self.window.running() && keep_running() {
            self.window.render().map_err(display)?;
            std::thread::sleep(PICTURE_TIME);
        }
        Ok(())
    }
}

impl Screen {
    /// Shows the environment's current state. A push with the mouse pushes the humanoid.
    pub fn show(&mut self, environment: &mut dyn Simulated) {
        let (model, scenery) = (environment.model(), environment.scenery());
        if !self.model.is_compatible_with_model(&model) {
            self.ghost_body = self.ghost.map(|_| GhostBody::new(&model));
        }
        let target = model.name_to_id(MjtObjBase::mjOBJ_SITE, TARGET);
        scenery.mark_target(target, environment.simulation_mut());
        self.model = model;
        // The lock is poisoned when the window's thread panicked. Then there is nothing to show.
        let Ok(mut state) = self.state.lock() else { return };
        state.sync_data(environment.simulation_mut());
        if let (Some(body), Some(ghost), Some(reference)) = (&mut self.ghost_body, self.ghost, &scenery.reference) {
            body.set_pose(reference, ghost, AZIMUTH);
            body.draw(state.user_scene_mut(), &MjvOption::default());
        }
    }
}

/// The model with settings for the window's first view: near the humanoid, from the side. The model's own settings would
/// show a whole corridor of 100 m.
fn near_the_humanoid(model: &MjModel, simulation: &Simulation) -> MjModel {
    let mut settings = model.clone();
    let root = model.name_to_id(MjtObjBase::mjOBJ_BODY, &format!("{PREFIX}root"));
    if let Some(position) = root.and_then(|root| simulation.xpos().get(root)) {
        settings.stat_mut().center = *position;
    }
    // Clipping planes are relative to the extent. Their distances must not change.
    let shrunk = (settings.stat().extent / EXTENT) as f32;
    settings.stat_mut().extent = EXTENT;
    let visual = settings.vis_mut();
    (visual.map.znear, visual.map.zfar) = (visual.map.znear * shrunk, visual.map.zfar * shrunk);
    visual.global.elevation = ELEVATION;
    settings
}

fn display(error: MjViewerError) -> Error {
    let cause = std::error::Error::source(&error).map(|cause| format!(": {cause}")).unwrap_or_default();
    Error::Display { reason: format!("{error}{cause}") }
}
