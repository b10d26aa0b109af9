//! The tasks without a reference. A task is one file with a type that implements [`Rules`](interface::Rules).

mod ball_catch;
pub mod comparison;
mod corridor;
mod environment;
mod gaps;
mod get_up;
mod go_to_target;
mod interface;
mod poses;
mod speed;
mod stage;
mod walls;
