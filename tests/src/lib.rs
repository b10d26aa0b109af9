//! What the whole-system tests share.
//!
//! # Layout
//! - [`certificates`] makes certificates, expired ones too.
//! - [`compose`] runs a learner and actors in containers.
//! - [`kubernetes`] renders the manifests and reads them.
//! - [`lockstep`] is runs of which the seed decides every parameter.
//! - [`modules`] finds circles among the modules of a crate.
//! - [`process`] is one program that runs.
//! - [`relay`] is a slow way to the learner.
//! - [`repository`] looks at the workspace's own files and dependencies.
//! - [`steps`] is what they make a learner and its actors go through.
//! - [`system`] runs a learner and actors as a user would: real programs, real sockets, one directory for the run.
//! - [`tensorboard`] reads curves as TensorBoard does.

pub mod certificates;
pub mod compose;
pub mod kubernetes;
pub mod lockstep;
pub mod modules;
pub mod process;
pub mod relay;
pub mod repository;
pub mod steps;
pub mod system;
pub mod tensorboard;
