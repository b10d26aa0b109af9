//! `comic-actor view`.

use clap::Args;
use comic_tasks::Ghost;

use super::scene::Scene;
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
