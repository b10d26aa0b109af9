//! A window on an environment: MuJoCo's viewer, as mujoco-rs has it. Feature `viewer`.
//!
//! The window belongs to the process's first thread, and its OpenGL does not let that of the humanoid's sight into the
//! same thread: environments are played in another one, and shown through a [`Screen`].

use std::sync::{Arc, Mutex};
use std::time::Duration;

use mujoco_rs::prelude::*;
use mujoco_rs::viewer::{MjViewer, MjViewerError, ViewerSharedState};

use crate::arenas::floor::TARGET;
use crate::error::Error;
use crate::ghost::{Ghost, Phantom};
use crate::humanoid::PREFIX;
use crate::{Simulated, Simulation};

/// What the window shows at first: an extent of so many metres, seen from one and a half times as far, and how far the
/// camera looks down (degrees).
const EXTENT: f64 = 2.5;
const ELEVATION: f32 = -14.0;
/// Where the window's camera looks at first (rad, from +x): MuJoCo's default.
const AZIMUTH: f64 = std::f64::consts::FRAC_PI_2;
/// The least between two pictures: 60 a second.
const PICTURE_TIME: Duration = Duration::from_micros(16_667);

/// The window, which belongs to the process's first thread.
#[derive(Debug)]
pub struct Viewer {
    window: MjViewer,
}

/// Where an environment is shown, from any thread.
#[derive(Debug)]
pub struct Screen {
    state: Arc<Mutex<ViewerSharedState>>,
    ghost: Option<Ghost>,
    phantom: Option<Phantom>,
    model: Arc<MjModel>,
}

impl Viewer {
    /// Opens a window on environments like this one.
    ///
    /// # Errors
    /// [`Error::Display`] when there is no display, or no OpenGL on it.
    pub fn open(environment: &dyn Simulated, ghost: Option<Ghost>) -> Result<(Self, Screen), Error> {
        // Asked first, for an answer that names the variables.
        if ["DISPLAY", "WAYLAND_DISPLAY"].iter().all(|name| std::env::var_os(name).is_none_or(|name| name.is_empty())) {
            return Err(Error::Display { reason: "neither DISPLAY nor WAYLAND_DISPLAY is set".into() });
        }
        let model = environment.model();
        let phantom = ghost.map(|_| Phantom::new(&model));
        let parts = phantom.as_ref().map_or(0, Phantom::parts) as usize;
        let settings = near_the_humanoid(&model, environment.simulation());
        let window =
            MjViewer::builder().window_name("CoMic").max_user_geoms(parts).build_passive(&settings).map_err(display)?;
        let screen = Screen { state: Arc::clone(window.state()), ghost, phantom, model };
        Ok((Self { window }, screen))
    }

    /// Draws what is shown until the window is closed, or `goes_on` says no.
    ///
    /// # Errors
    /// [`Error::Display`] when OpenGL fails.
    pub fn run(&mut self, goes_on: impl Fn() -> bool) -> Result<(), Error> {
        while self.window.running() && goes_on() {
            self.window.render().map_err(display)?;
            std::thread::sleep(PICTURE_TIME);
        }
        Ok(())
    }
}

impl Screen {
    /// Shows the environment as it stands. A push with the mouse pushes the humanoid.
    pub fn show(&mut self, environment: &mut dyn Simulated) {
        let (model, scenery) = (environment.model(), environment.scenery());
        if !self.model.is_compatible_with_model(&model) {
            self.phantom = self.ghost.map(|_| Phantom::new(&model));
        }
        let target = model.name_to_id(MjtObjBase::mjOBJ_SITE, TARGET);
        scenery.mark_target(target, environment.simulation_mut());
        self.model = model;
        // A window that panicked shows nothing any more.
        let Ok(mut state) = self.state.lock() else { return };
        state.sync_data(environment.simulation_mut());
        if let (Some(phantom), Some(ghost), Some(reference)) = (&mut self.phantom, self.ghost, &scenery.reference) {
            phantom.stand(reference, ghost, AZIMUTH);
            phantom.appear(state.user_scene_mut(), &MjvOption::default());
        }
    }
}

/// The model with the settings that decide where the window's camera begins: by the humanoid, from the side. Left to
/// themselves they would show all of a corridor of 100 m.
fn near_the_humanoid(model: &MjModel, simulation: &Simulation) -> MjModel {
    let mut settings = model.clone();
    let root = model.name_to_id(MjtObjBase::mjOBJ_BODY, &format!("{PREFIX}root"));
    if let Some(position) = root.and_then(|root| simulation.xpos().get(root)) {
        settings.stat_mut().center = *position;
    }
    // Clipping planes are relative to the extent, and stay where they are.
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
