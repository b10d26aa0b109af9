//! `cargo xtask setup`: the crate comic-setup with this repository's `.deps`.

use anyhow::Result;

use crate::workspace;

pub(crate) use comic_setup::Options;

/// Brings `.deps` to the state that the pins describe. Takes less than a second if it is already.
pub(crate) fn run(options: &Options) -> Result<()> {
    comic_setup::run(options, &workspace::dependencies())
}
