//! Films a policy, or shows it in a window.
//!
//! # Layout
//! - [`scene`] is the task and the policy of a film or a window; [`evaluate`](crate::evaluate) rolls it out.
//! - [`recorder`] draws an environment's steps into a film, also during an evaluation.
//! - [`encode`] writes pictures one by one as GIF, WebP, MP4 or a contact sheet; no film is held in memory.
//! - [`command`] is `comic-actor render`, [`view`] is `comic-actor view`.

pub mod command;
pub mod encode;
pub mod recorder;
mod scene;
pub mod view;
