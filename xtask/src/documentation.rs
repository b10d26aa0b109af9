//! `cargo xtask docs`: the pages of every crate's items, and the book of `docs/`.

use anyhow::Result;

use crate::setup;
use crate::workspace::{self, cargo, root, run};

/// Builds rustdoc's pages, a warning being an error, and the book where mdbook is installed.
pub(crate) fn build() -> Result<()> {
    setup::run(&setup::Options::default())?;
    let mut pages = cargo();
    pages.args(["doc", "--release", "--no-deps", "--workspace", "--document-private-items"]);
    // The pages include private items, so links to them work.
    run(pages.env("RUSTDOCFLAGS", "--deny warnings --allow rustdoc::private_intra_doc_links"))?;
    if !workspace::answers("mdbook", &["--version"]) {
        eprintln!("NOT RUN: the book of docs/: `cargo install mdbook`");
        return Ok(());
    }
    run(std::process::Command::new("mdbook").args(["build", "docs"]).current_dir(root()))
}
