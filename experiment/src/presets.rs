//! The built-in experiments.

/// Name and document of every preset, in the order they are listed to a user.
pub const ALL: [(&str, &str); 3] = [
    ("quickstart", include_str!("../presets/quickstart.toml")),
    ("quickstart-from-zero", include_str!("../presets/quickstart-from-zero.toml")),
    ("tracking-mlp", include_str!("../presets/tracking-mlp.toml")),
];
