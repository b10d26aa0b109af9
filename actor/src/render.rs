//! Films a policy, or shows it in a window.
//!
//! # Layout
//! - [`scene`] is the task and the policy of a film or a window; [`evaluate`](crate::evaluate) rolls it out.
//! - [`command`] is `comic-actor render`, which makes a [`film`](crate::film); [`view`] is `comic-actor view`.

pub mod command;
mod scene;
pub mod view;
