//! `comic-actor render`.

use std::io::IsTerminal as _;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::sync::Arc;

use clap::Args;
use comic_tasks::{Simulated, Step};
use indicatif::{ProgressBar, ProgressStyle};

use super::scene::Scene;
use crate::Error;
use crate::evaluate::Audience;
use crate::film::encode::Format;
use crate::film::recorder::{Look, Recorder};
use crate::output_file::OutputFile;
use crate::page;
use crate::page::recorder::PageRecorder;

/// The most seconds of an episode that are filmed unless asked for.
const USUAL_SECONDS: f64 = 10.0;
/// The most seconds that can be asked for: an hour.
const MOST_SECONDS: f64 = 3600.0;
/// The most seconds of a page. A browser reads it as a whole, about 20 MB for this time.
const MOST_PAGE_SECONDS: f64 = 600.0;
/// Steps between two log lines, when there is no terminal.
const STEPS_A_LINE: usize = 1000;
/// The most episodes that can be asked for.
const MOST_EPISODES: i64 = 1000;

/// Shows a policy, without a display: .html (a page for any browser), .gif, .webp, .mp4 (through ffmpeg) or .png (a contact
/// sheet).
#[derive(Args, Clone, Debug)]
pub struct Render {
    #[command(flatten)]
    scene: Scene,
    #[command(flatten)]
    look: Look,
    /// Seconds to film, episode after episode; the first episode, 10 s of it at most, unless given.
    #[arg(long, value_name = "S", value_parser = seconds, help_heading = "Film")]
    seconds: Option<f64>,
    /// Whole episodes to film, at most one for each start, spread evenly over the clip's starts; --start is the first.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=MOST_EPISODES))]
    #[arg(conflicts_with = "seconds", help_heading = "Film")]
    episodes: Option<u16>,
    /// The film; the extension chooses the format: .html, .gif, .webp, .mp4 or .png.
    #[arg(long, value_name = "FILE", help_heading = "Film")]
    out: PathBuf,
}

impl Render {
    /// Makes the film or the page.
    ///
    /// # Errors
    /// A wrong command line, a checkpoint that cannot be used, a failing rollout, film or page.
    pub fn run(&self) -> Result<(), Error> {
        // Errors of the film's options are reported before the task is built.
        self.look.suits(self.scene.task())?;
        let is_page = page::is_page(&self.out);
        let ghost = if is_page { self.look.of_page()? } else { Format::of(&self.out).map(|_| None)? };
        let most = if is_page { MOST_PAGE_SECONDS } else { MOST_SECONDS };
        if self.seconds.is_some_and(|seconds| seconds > most) {
            return Err(Error::Usage(format!("--seconds: a page holds {most} s at most: ask for fewer")));
        }
        let mut cast = self.scene.cast()?;
        let (task, step) = (Arc::clone(&cast.task), cast.task.control_timestep());
        let spec = task.spec();
        let seconds = self.seconds.unwrap_or(if self.episodes.is_some() { most } else { USUAL_SECONDS });
        let steps = (seconds / step - 1e-9).ceil() as usize;
        let target = if is_page {
            let file = OutputFile::create(&self.out).map_err(Error::file(&self.out))?;
            Target::Page(PageRecorder::new(spec, self.look.every(step)), file)
        } else {
            Target::Film(Box::new(Recorder::new(&self.look, &self.out, step)?))
        };
        let mut filming = Filming { target, left: steps, bar: bar(steps) };
        let mut finished = match (self.episodes, self.seconds) {
            (Some(episodes), _) => cast.play_spread(episodes.into(), &mut filming)?,
            // Every episode has at least one step, so there are enough episodes.
            (None, Some(_)) => cast.play(steps, &mut filming)?,
            (None, None) => cast.play(1, &mut filming)?,
        };
        if let Some(bar) = filming.bar {
            bar.finish_and_clear();
        }
        if self.episodes.is_some() && filming.left == 0 {
            tracing::warn!(
                episodes = finished.len(),
                seconds,
                "no more fits: the last episodes are left out or cut off"
            );
        }
        match filming.target {
            Target::Film(recorder) => recorder.finish(),
            Target::Page(recorder, file) => {
                finished.sort_by_key(|episode| episode.number);
                let endings: Vec<_> = finished.iter().map(|episode| episode.ending(spec, String::new())).collect();
                recorder.document(self.scene.title(), step, ghost, &endings).write(file)
            }
        }
    }
}

/// What records the steps.
enum Target<'a> {
    Film(Box<Recorder>),
    Page(PageRecorder<'a>, OutputFile),
}

/// Records every step until the time is over.
struct Filming<'a> {
    target: Target<'a>,
    /// Steps to record.
    left: usize,
    bar: Option<ProgressBar>,
}

impl Audience<Box<dyn Simulated>> for Filming<'_> {
    fn watch(
        &mut self,
        number: usize,
        environment: &mut Box<dyn Simulated>,
        step: Option<&Step>,
    ) -> Result<ControlFlow<()>, Error> {
        match &mut self.target {
            Target::Film(recorder) => recorder.shoot(environment.as_mut())?,
            Target::Page(recorder, _) => recorder.record(number, environment.as_ref(), step)?,
        }
        self.left = self.left.saturating_sub(1);
        match &self.bar {
            Some(bar) => bar.inc(1),
            None if self.left > 0 && self.left.is_multiple_of(STEPS_A_LINE) => {
                tracing::info!(steps_left = self.left, "filming")
            }
            None => {}
        }
        Ok(if self.left > 0 { ControlFlow::Continue(()) } else { ControlFlow::Break(()) })
    }

    fn count(&mut self, _: usize, _: usize) {}
}

/// A bar of so many steps, on a terminal.
fn bar(steps: usize) -> Option<ProgressBar> {
    let bar = std::io::stderr().is_terminal().then(|| ProgressBar::new(steps as u64))?;
    let style = ProgressStyle::with_template("{bar:40} {pos} of {len} steps, {eta} left");
    Some(style.map_or(bar.clone(), |style| bar.with_style(style)))
}

fn seconds(text: &str) -> Result<f64, String> {
    let seconds = text.parse::<f64>().ok().filter(|seconds| *seconds > 0.0 && *seconds <= MOST_SECONDS);
    seconds.ok_or_else(|| format!("`{text}` is not within 0 and {MOST_SECONDS} s"))
}
