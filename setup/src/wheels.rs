//! The wheels that set-up fetches, pinned by version and hash.

mod accelerators;
mod cpu;

use crate::wheel::Wheel;

/// Every wheel.
pub(crate) fn wheels() -> impl Iterator<Item = &'static Wheel> {
    cpu::WHEELS.iter().chain(&accelerators::WHEELS)
}
