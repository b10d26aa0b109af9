//! Episodes as a page: one HTML file that plays them in a browser, without a network and without this program.
//!
//! # Layout
//! - [`recorder`] follows environments and keeps the poses of their bodies and their rewards.
//! - [`document`] is the data in the page, and writes the file.
//! - `viewer/` is what the browser runs. It draws with three.js (`actor/data/three`).

pub mod document;
pub mod recorder;

use std::path::Path;

/// The last two parts of a path: they tell which run or checkpoint it is, and not where it lies.
pub(crate) fn short(path: &Path) -> String {
    let parts: Vec<_> = path.iter().collect();
    let last: std::path::PathBuf = parts.iter().skip(parts.len().saturating_sub(2)).collect();
    last.display().to_string()
}

/// Whether a file's name is that of a page: it ends in `.html`.
pub fn is_page(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("html"))
}
