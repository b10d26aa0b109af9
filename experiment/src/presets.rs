//! The built-in experiments.

/// Name and document of every preset, in the order they are listed to a user.
pub const ALL: [(&str, &str); 8] = [
    ("quickstart", include_str!("../presets/quickstart.toml")),
    ("quickstart-from-zero", include_str!("../presets/quickstart-from-zero.toml")),
    ("tracking-mlp", include_str!("../presets/tracking-mlp.toml")),
    ("go-to-target", include_str!("../presets/go-to-target.toml")),
    ("gaps", include_str!("../presets/gaps.toml")),
    ("walls", include_str!("../presets/walls.toml")),
    ("get-up", include_str!("../presets/get-up.toml")),
    ("ball-catch", include_str!("../presets/ball-catch.toml")),
];
