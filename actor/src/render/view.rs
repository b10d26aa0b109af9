//! `comic-actor view`.

use clap::Args;
use comic_tasks::Ghost;

use super::scene::Scene;
#[cfg(not(feature = "viewer"))]
use crate::Error;

/// Shows a policy in MuJoCo's viewer until the window is closed.
#[derive(Args, Clone, Debug)]
pub struct View {
    #[command(flatten)]
    scene: Scene,
    /// The reference as a ghost, in tracking: on the humanoid, or with `--ghost=beside` a metre beside it.
    #[arg(long, value_name = "WHERE", num_args = 0..=1, require_equals = true, default_missing_value = "on")]
    ghost: Option<Ghost>,
}

impl View {
    /// Opens the window.
    ///
    /// # Errors
    /// No display, or a program that was built without the viewer.
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
    use std::sync::Arc;
    use std::sync::atomic::{AtomicBool, Ordering};
    use std::time::{Duration, Instant};

    use comic_tasks::viewer::{Screen, Viewer};
    use comic_tasks::{Simulated, Step};

    use super::View;
    use crate::Error;
    use crate::evaluate::Audience;

    /// Episodes after which the window closes by itself.
    const EPISODES: usize = 100_000;

    impl View {
        /// Opens the window.
        ///
        /// # Errors
        /// No display, or errors of the scene.
        pub fn run(&self) -> Result<(), Error> {
            let mut cast = self.scene.cast()?;
            let step = Duration::from_secs_f64(cast.task.control_timestep());
            // The viewer needs its model only: the episodes run in other environments.
            let environment = Arc::clone(&cast.task).environment(0)?;
            let (mut viewer, screen) = Viewer::open(environment.as_ref(), self.ghost)?;
            let open = AtomicBool::new(true);
            let mut shown = Shown { screen, open: &open, step, due: Instant::now() };
            std::thread::scope(|scope| {
                let player = scope.spawn(move || cast.play(EPISODES, &mut shown).map(drop));
                let closed = viewer.run(|| !player.is_finished());
                open.store(false, Ordering::Relaxed);
                player.join().map_err(|_| Error::WorkerPanicked)??;
                Ok(closed?)
            })
        }
    }

    /// Shows every step at its time, until the window is closed.
    struct Shown<'a> {
        screen: Screen,
        open: &'a AtomicBool,
        step: Duration,
        due: Instant,
    }

    impl Audience<Box<dyn Simulated>> for Shown<'_> {
        fn watch(
            &mut self,
            _: usize,
            environment: &mut Box<dyn Simulated>,
            _: Option<&Step>,
        ) -> Result<ControlFlow<()>, Error> {
            self.screen.show(environment.as_mut());
            // Lost time is not made up for.
            self.due = (self.due + self.step).max(Instant::now());
            std::thread::sleep(self.due - Instant::now());
            let open = self.open.load(Ordering::Relaxed);
            Ok(if open { ControlFlow::Continue(()) } else { ControlFlow::Break(()) })
        }

        fn count(&mut self, _: usize, _: usize) {}
    }
}
