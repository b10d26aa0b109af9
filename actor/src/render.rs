//! Looking: films of a policy at work, and a window on it.
//!
//! # Layout
//! - [`scene`] is who acts in which task; a film and a window share it, and the acting itself is
//!   [`evaluate`](crate::evaluate)'s.
//! - [`recorder`] draws an environment step by step into a film, of an evaluation too.
//! - [`encode`] writes pictures as GIF, WebP, MP4 or a contact sheet, one after the other: no film is held in memory.
//! - [`command`] is `comic-actor render`, [`view`] is `comic-actor view`.

pub mod command;
pub mod encode;
pub mod recorder;
mod scene;
pub mod view;
