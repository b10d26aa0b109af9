//! Episodes as a page: one HTML file that plays them in a browser, without a network and without this program.
//!
//! # Layout
//! - [`recorder`] follows environments and keeps the poses of their bodies and their rewards.
//! - [`document`] is the data in the page, and writes the file.
//! - `viewer/` is what the browser runs. It draws with three.js (`actor/data/three`).

pub mod document;
pub mod recorder;

use std::path::Path;

/// Whether a file's name is that of a page: it ends in `.html`.
pub fn is_page(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("html"))
}
