//! The built-in experiments.

/// Name and document of every preset, in the order they are listed to a user.
pub const ALL: [(&str, &str); 2] = [
    ("quickstart", include_str!("../presets/quickstart.toml")),
    ("tracking-mlp", include_str!("../presets/tracking-mlp.toml")),
];
