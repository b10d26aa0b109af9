//! The learner as actors and operators see it, with a real server on a real socket; and its checkpoint directory.
//!
//! All of this is one binary, because linking a binary takes longer than these tests.

mod assets;
mod back_pressure;
mod checkpoints;
mod frames;
mod health;
mod join;
mod limits;
mod metrics_page;
mod parameters;
mod room;
mod shutdown;
mod status;
mod strangers;
mod support;
mod tls;
mod token;
mod unrolls;
