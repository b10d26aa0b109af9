//! Films, which `comic-actor render` makes, and evaluations too.
//!
//! # Layout
//! - [`recorder`] draws an environment's steps into a film.
//! - [`encode`] writes pictures one by one as GIF, WebP, MP4 or a contact sheet; no film is held in memory.

pub mod encode;
pub mod recorder;
