//! Draws the steps of an environment into a film.

use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::{Args, ValueEnum};
use comic_experiment::TaskName;
use comic_tasks::film::{Camera, Film, Shot, Size};
use comic_tasks::{Ghost, Simulated};

use super::encode::{Format, Movie};
use crate::Error;

/// How a film looks.
#[derive(Args, Clone, Debug)]
pub struct Look {
    /// The camera.
    #[arg(long, value_enum, default_value_t = Place::Tracking, help_heading = "Film")]
    camera: Place,
    /// The reference as a ghost, in tracking: on the humanoid, or with `--ghost=beside` a metre beside it.
    #[arg(long, value_name = "WHERE", num_args = 0..=1, require_equals = true, default_missing_value = "on")]
    #[arg(help_heading = "Film")]
    ghost: Option<Ghost>,
    /// Width and height of a picture in pixels; 640x480 for an .mp4, 320x240 a tile of a .png, else 400x300.
    #[arg(long, value_name = "WxH", help_heading = "Film")]
    size: Option<Size>,
    /// The most pictures a second; every control step is one unless given. A film runs as fast as the world.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1000), help_heading = "Film")]
    fps: Option<u16>,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Place {
    /// From behind its right shoulder, following it.
    Tracking,
    /// The humanoid's own camera.
    Egocentric,
    /// From its right, following it.
    Side,
}

/// Films environments of one task.
pub struct Recorder {
    film: Film,
    movie: Movie,
    out: PathBuf,
    /// Seconds of a control step.
    step: f64,
    /// Control steps from frame to frame.
    every: usize,
    steps: usize,
    frames: usize,
}

impl Look {
    /// For a film of some hundred KB: 160 × 120 pixels, 11 pictures a second, beside the reference if there is one.
    pub(crate) fn small(task: TaskName) -> Self {
        let ghost = (task == TaskName::Tracking).then_some(Ghost::Beside);
        Self { camera: Place::Tracking, ghost, size: Size::new(160, 120), fps: Some(12) }
    }

    /// For a contact sheet: a tile every third of a second.
    pub(crate) fn sheet() -> Self {
        Self { camera: Place::Side, ghost: None, size: Size::new(160, 120), fps: Some(3) }
    }

    /// Control steps of `step` seconds from one picture to the next.
    pub(crate) fn every(&self, step: f64) -> usize {
        self.fps.map_or(1, |fps| ((1.0 / (f64::from(fps) * step)) - 1e-9).ceil().max(1.0) as usize)
    }

    /// Where a page has the reference at first; `None` hides it.
    ///
    /// # Errors
    /// A size or a camera: who looks at the page chooses them.
    pub(crate) fn of_page(&self) -> Result<Option<Ghost>, Error> {
        let refused = match (self.size, self.camera) {
            (Some(_), _) => "--size",
            (None, Place::Egocentric | Place::Side) => "--camera",
            (None, Place::Tracking) => return Ok(self.ghost),
        };
        Err(Error::Usage(format!("{refused}: a page has none, who looks at it turns and zooms: leave the option out")))
    }

    /// Checks whether a film of this task can look like this.
    ///
    /// # Errors
    /// A ghost in a task without a reference.
    pub fn suits(&self, task: TaskName) -> Result<(), Error> {
        if self.ghost.is_none() || task == TaskName::Tracking {
            return Ok(());
        }
        Err(Error::Usage(format!(
            "--ghost: {task} has no reference to show, only tracking has one: leave the option out"
        )))
    }
}

impl Recorder {
    /// Begins a film in the file `out` of a task with control steps of `step` seconds.
    ///
    /// # Errors
    /// An unknown extension, or a file that cannot be created.
    pub fn new(look: &Look, out: &Path, step: f64) -> Result<Self, Error> {
        let size = match look.size {
            Some(size) => size,
            None => Format::of(out)?.usual_size().parse().map_err(Error::Usage)?,
        };
        let every = look.every(step);
        let camera = match look.camera {
            Place::Tracking => Camera::Tracking,
            Place::Egocentric => Camera::Egocentric,
            Place::Side => Camera::Side,
        };
        let film = Film::new(Shot { size, camera, ghost: look.ghost });
        let movie = Movie::create(out, size, Duration::from_secs_f64(step * every as f64))?;
        Ok(Self { film, movie, out: out.to_path_buf(), step, every, steps: 0, frames: 0 })
    }

    /// Draws a picture of the environment if one is due. Called at an episode's begin and after each of its steps.
    ///
    /// # Errors
    /// [`comic_tasks::Error::Graphics`] when OpenGL is not available, [`Error::File`] when the film cannot be
    /// written.
    pub fn shoot(&mut self, environment: &mut dyn Simulated) -> Result<(), Error> {
        if self.steps.is_multiple_of(self.every) {
            self.movie.frame(self.film.draw(environment)?)?;
            self.frames += 1;
        }
        self.steps += 1;
        Ok(())
    }

    /// Seconds filmed so far.
    pub fn seconds(&self) -> f64 {
        self.steps as f64 * self.step
    }

    /// Finishes the film.
    ///
    /// # Errors
    /// [`Error::File`] when it cannot be written.
    pub fn finish(self) -> Result<(), Error> {
        let (frames, seconds) = (self.frames, self.seconds());
        self.movie.finish()?;
        tracing::info!(file = %self.out.display(), frames, seconds = format!("{seconds:.2}"), "filmed");
        Ok(())
    }
}
