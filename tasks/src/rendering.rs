//! Drawing with MuJoCo: films and a window for people, camera images for the policy. And shapes and poses as numbers, for
//! viewers of other programs.

pub mod film;
pub mod geometry;
pub(crate) mod ghost;
#[cfg(feature = "viewer")]
pub mod viewer;
pub mod vision;
