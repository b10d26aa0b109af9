//! Helpers of the whole-system tests.
//!
//! # Layout
//! - [`accounting`] checks its law.
//! - [`certificates`] makes certificates, also expired ones.
//! - [`compose`] runs a learner and actors in containers.
//! - [`kubernetes`] renders the manifests and reads them.
//! - [`lockstep`] starts runs in which the seed decides every parameter.
//! - [`modules`] finds circles among the modules of a crate.
//! - [`process`] is a running program.
//! - [`ranks`] are several learners that train one run.
//! - [`relay`] is a slow line to the learner.
//! - [`repository`] reads the workspace's own files and dependencies.
//! - [`steps`] are the steps that several tests take with a learner and its actors.
//! - [`system`] runs a learner and actors as a user does: real programs, real sockets, one directory for the run.
//! - [`tensorboard`] reads curves as TensorBoard does.

pub mod accounting;
pub mod certificates;
pub mod compose;
pub mod kubernetes;
pub mod lockstep;
pub mod modules;
pub mod process;
pub mod ranks;
pub mod relay;
pub mod repository;
pub mod steps;
pub mod system;
pub mod tensorboard;
