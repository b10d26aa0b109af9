//! The camera images of the policy: MuJoCo draws the humanoid's egocentric camera (`cmu_humanoid.py`, `egocentric_camera`).
//!
//! Drawing needs OpenGL through EGL, and no display. An OpenGL context belongs to the thread that made it and takes long to
//! make. Each thread makes one when it first draws the arenas of a task, and uses it for all its environments of that task.

use std::cell::RefCell;

use comic_experiment::{IMAGE_SIZE, Vision};
use mujoco_rs::prelude::*;
use mujoco_rs::renderer::{MjRenderer, RendererError};

use crate::error::{Error, missing};
use crate::humanoid::PREFIX;
use crate::physics::Simulation;

/// Bytes of an image: rows from the top, pixels from the left, red, green, blue.
pub const IMAGE_BYTES: usize = IMAGE_SIZE * IMAGE_SIZE * 3;
/// The camera's name.
const CAMERA: &str = "egocentric";
/// The group of geoms that the egocentric camera does not show: the nose (`_WALKER_INVIS_GROUP`).
const INVISIBLE_GROUP: usize = 1;
/// Faces around a round body (D). MuJoCo's 28 are for large pictures: in 64 pixels they take longer than everything else.
/// docs/benchmarks.md has the difference in the images.
const SLICES: i32 = 12;
/// Faces from one pole of a round body to the other (D). MuJoCo has 16.
const STACKS: i32 = 8;

thread_local! {
    /// The cameras of this thread, each with its quality and its task. A context has the textures of the model that it was
    /// made for, which another task's arenas do not have.
    static CAMERAS_OF_THREAD: RefCell<Vec<(Vision, &'static str, Camera)>> = const { RefCell::new(Vec::new()) };
}

/// Draws the camera image of `simulation`, in an arena of `task`, into `image`, which has [`IMAGE_BYTES`] bytes.
/// [`Vision::Off`] does nothing.
///
/// # Errors
/// [`Error::Graphics`]: there is no OpenGL.
pub(crate) fn draw(
    vision: Vision,
    task: &'static str,
    simulation: &mut Simulation,
    image: &mut [u8],
) -> Result<(), Error> {
    if vision == Vision::Off {
        return Ok(());
    }
    CAMERAS_OF_THREAD.with_borrow_mut(|cameras| {
        let known = cameras.iter().position(|(quality, owner, _)| (*quality, *owner) == (vision, task));
        let index = match known {
            Some(index) => index,
            None => {
                cameras.push((vision, task, Camera::new(simulation.model(), vision)?));
                cameras.len() - 1
            }
        };
        cameras[index].2.draw(simulation, image)
    })
}

/// An OpenGL context without a window, and the egocentric camera in it.
#[derive(Debug)]
struct Camera {
    renderer: MjRenderer,
}

impl Camera {
    fn new(model: &MjModel, vision: Vision) -> Result<Self, Error> {
        let (camera, options) = egocentric(model)?;
        // The model of a context decides its settings. It can draw any model with the same layout.
        let mut settings = model.clone();
        if vision == Vision::Fast {
            let visual = settings.vis_mut();
            (visual.quality.shadowsize, visual.quality.offsamples) = (0, 0);
            (visual.quality.numslices, visual.quality.numstacks) = (SLICES, STACKS);
            (visual.global.offwidth, visual.global.offheight) = (IMAGE_SIZE as i32, IMAGE_SIZE as i32);
        }
        let size = IMAGE_SIZE as u32;
        let renderer = MjRenderer::builder()
            .width(size)
            .height(size)
            .camera(camera)
            .opts(options)
            .build(&settings)
            .map_err(graphics)?;
        Ok(Self { renderer })
    }

    fn draw(&mut self, simulation: &mut Simulation, image: &mut [u8]) -> Result<(), Error> {
        self.renderer.sync_data(simulation).map_err(graphics)?;
        self.renderer.render().map_err(graphics)?;
        if let Some(drawn) = self.renderer.rgb_flat() {
            image.copy_from_slice(drawn);
        }
        Ok(())
    }
}

/// The egocentric camera and its drawing options.
pub(crate) fn egocentric(model: &MjModel) -> Result<(MjvCamera, MjvOption), Error> {
    let camera = model
        .name_to_id(MjtObjBase::mjOBJ_CAMERA, &format!("{PREFIX}{CAMERA}"))
        .ok_or_else(|| missing("camera", CAMERA))?;
    let mut options = MjvOption::default();
    options.geomgroup[INVISIBLE_GROUP] = 0;
    options.flags[MjtVisFlag::mjVIS_RANGEFINDER as usize] = 0;
    Ok((MjvCamera::new_fixed(camera), options))
}

/// An error of OpenGL.
pub(crate) fn graphics(error: RendererError) -> Error {
    let cause = std::error::Error::source(&error).map(|cause| format!(": {cause}")).unwrap_or_default();
    Error::Graphics { reason: format!("{error}{cause}") }
}
