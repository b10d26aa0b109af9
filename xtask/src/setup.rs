//! `cargo xtask setup`: what the crate comic-setup does, into this repository's `.deps`.

use anyhow::Result;

use crate::workspace;

pub(crate) use comic_setup::Options;

/// Brings `.deps` to what the pins say; under a second when it is already.
pub(crate) fn run(options: &Options) -> Result<()> {
    comic_setup::run(options, &workspace::dependencies())
}
