//! `comic-actor render`.

use std::ops::ControlFlow;
use std::path::PathBuf;

use clap::Args;
use comic_tasks::Simulated;

use super::scene::Scene;
use crate::Error;
use crate::evaluate::Audience;
use crate::film::encode::Format;
use crate::film::recorder::{Look, Recorder};

/// The most seconds of an episode that are filmed unless asked for.
const USUAL_SECONDS: f64 = 10.0;
/// The most seconds that can be asked for: an hour.
const MOST_SECONDS: f64 = 3600.0;

/// Films a policy, without a display: .gif, .webp, .mp4 (through ffmpeg) or .png (a contact sheet).
#[derive(Args, Clone, Debug)]
pub struct Render {
    #[command(flatten)]
    scene: Scene,
    #[command(flatten)]
    look: Look,
    /// Seconds to film, episode after episode; the first episode, 10 s of it at most, unless given.
    #[arg(long, value_name = "S", value_parser = seconds, help_heading = "Film")]
    seconds: Option<f64>,
    /// The film; the extension chooses the format: .gif, .webp, .mp4 or .png.
    #[arg(long, value_name = "FILE", help_heading = "Film")]
    out: PathBuf,
}

impl Render {
    /// Makes the film.
    ///
    /// # Errors
    /// A wrong command line, a checkpoint that cannot be used, a failing rollout or film.
    pub fn run(&self) -> Result<(), Error> {
        // Errors of the film's options are reported before the task is built.
        Format::of(&self.out)?;
        self.look.suits(self.scene.task())?;
        let mut cast = self.scene.cast()?;
        let step = cast.task.control_timestep();
        let seconds = self.seconds.unwrap_or(USUAL_SECONDS);
        let recorder = Recorder::new(&self.look, &self.out, step)?.with_bar(seconds);
        let mut filming = Filming { recorder, seconds };
        // Every episode has at least one step, so there are enough episodes.
        let episodes = if self.seconds.is_some() { (seconds / step).ceil() as usize } else { 1 };
        cast.play(episodes, &mut filming)?;
        filming.recorder.finish()
    }
}

/// Films every step until the time is over.
struct Filming {
    recorder: Recorder,
    seconds: f64,
}

impl Audience<Box<dyn Simulated>> for Filming {
    fn watch(&mut self, _: usize, environment: &mut Box<dyn Simulated>) -> Result<ControlFlow<()>, Error> {
        self.recorder.shoot(environment.as_mut())?;
        let over = self.recorder.seconds() >= self.seconds - 1e-9;
        Ok(if over { ControlFlow::Break(()) } else { ControlFlow::Continue(()) })
    }

    fn count(&mut self, _: usize, _: usize) {}
}

fn seconds(text: &str) -> Result<f64, String> {
    let seconds = text.parse::<f64>().ok().filter(|seconds| *seconds > 0.0 && *seconds <= MOST_SECONDS);
    seconds.ok_or_else(|| format!("`{text}` is not within 0 and {MOST_SECONDS} s"))
}
