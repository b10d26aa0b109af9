//! What `comic-learner` does other than serve: one file for each command.

pub mod certs;
pub mod export;
pub mod health;
pub mod sizes;
pub mod status;
