//! The learner as actors and operators see it, a real server on a real socket; and its checkpoint directory.
//!
//! One binary, since linking one takes longer than all of its tests.

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
mod support;
mod tls;
mod token;
mod unrolls;
