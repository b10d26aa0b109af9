//! What the whole-system tests share.
//!
//! # Layout
//! - [`repository`] looks at the workspace's own files and dependencies.
//! - [`steps`] is what they make a learner and its actors go through.
//! - [`system`] runs a learner and actors as a user would: real programs, real sockets, one directory for the run.

pub mod repository;
pub mod steps;
pub mod system;
