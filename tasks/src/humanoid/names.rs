//! Names of the humanoid's elements in a compiled model.

/// Prefix of every name that belongs to the humanoid.
pub const PREFIX: &str = "walker/";
/// Bodies whose origins are the end effectors, in the order of the observation (`cmu_humanoid.py`).
pub const END_EFFECTORS: [&str; 4] = ["rradius", "lradius", "rfoot", "lfoot"];
