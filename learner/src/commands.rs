//! The commands of `comic-learner` besides serving and training: one file for each.

pub mod certs;
pub mod export;
pub mod health;
pub mod low_level;
pub mod prior;
pub mod sizes;
pub mod status;
