//! `comic-actor view`.

use clap::Args;
use comic_tasks::Ghost;

use super::scene::Scene;
#[cfg(not(feature = "viewer"))]
use crate::Error;

/// Shows a policy at work in MuJoCo's viewer, until its window is closed.
#[derive(Args, Clone, Debug)]
pub struct View {
    #[command(flatten)]
    scene: Scene,
    /// The reference as a ghost, in tracking: on the humanoid, or with `--ghost=beside` a metre beside it.
    #[arg(long, value_name = "WHERE", num_args = 0..=1, require_equals = true, default_missing_value = "on")]
    ghost: Option<Ghost>,
}

impl View {
    /// Shows.
    ///
    /// # Errors
    /// Whatever keeps it from that: no display, or a program that was built without the viewer.
    #[cfg(not(feature = "viewer"))]
    pub fn run(&self) -> Result<(), Error> {
        let _ = (&self.scene, &self.ghost);
        Err(Error::Usage(
            "this program was built without the viewer: build it with `cargo build --release -p comic-actor --features \
             viewer`, or film with `comic-actor render`, which needs no display"
                .into(),
        ))
    }
}

#[cfg(feature = "viewer")]
mod window {
    use std::ops::ControlFlow;
    use std::time::{Duration, Instant};

    use comic_tasks::viewer::Viewer;
    use comic_tasks::{Ghost, Simulated};

    use super::View;
    use crate::Error;
    use crate::evaluate::Audience;

    /// Episodes after which the window closes by itself: nobody looks so long.
    const EPISODES: usize = 100_000;

    impl View {
        /// Shows.
        ///
        /// # Errors
        /// Whatever keeps it from that: no display, or what is wrong with the scene.
        pub fn run(&self) -> Result<(), Error> {
            let mut cast = self.scene.cast()?;
            let step = Duration::from_secs_f64(cast.task.control_timestep());
            let mut window = Window { viewer: None, ghost: self.ghost, step, due: Instant::now() };
            cast.play(EPISODES, &mut window).map(drop)
        }
    }

    /// Shows every step at its time.
    struct Window {
        /// Opened at the first episode.
        viewer: Option<Viewer>,
        ghost: Option<Ghost>,
        step: Duration,
        due: Instant,
    }

    impl Audience<Box<dyn Simulated>> for Window {
        fn watch(&mut self, _: usize, environment: &mut Box<dyn Simulated>) -> Result<ControlFlow<()>, Error> {
            let viewer = match &mut self.viewer {
                Some(viewer) => viewer,
                None => self.viewer.insert(Viewer::open(environment.as_ref(), self.ghost)?),
            };
            if !viewer.show(environment.as_mut())? {
                return Ok(ControlFlow::Break(()));
            }
            // Time that was lost is not caught up with.
            self.due = (self.due + self.step).max(Instant::now());
            std::thread::sleep(self.due - Instant::now());
            Ok(ControlFlow::Continue(()))
        }

        fn count(&mut self, _: usize, _: usize) {}
    }
}
