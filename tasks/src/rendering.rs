//! Drawing with MuJoCo: films and a window for people, camera images for the policy.

pub mod film;
pub(crate) mod ghost;
#[cfg(feature = "viewer")]
pub mod viewer;
pub mod vision;
