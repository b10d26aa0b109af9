//! The built-in experiments.

/// Name and document of every preset, in the order they are listed to a user.
pub const ALL: [(&str, &str); 13] = [
    ("quickstart", include_str!("../presets/quickstart.toml")),
    ("quickstart-from-zero", include_str!("../presets/quickstart-from-zero.toml")),
    ("tracking-mlp", include_str!("../presets/tracking-mlp.toml")),
    ("tracking-lstm", include_str!("../presets/tracking-lstm.toml")),
    ("tracking-mixture", include_str!("../presets/tracking-mixture.toml")),
    ("tracking-product", include_str!("../presets/tracking-product.toml")),
    ("joint-get-up", include_str!("../presets/joint-get-up.toml")),
    ("joint-ball", include_str!("../presets/joint-ball.toml")),
    ("go-to-target", include_str!("../presets/go-to-target.toml")),
    ("gaps", include_str!("../presets/gaps.toml")),
    ("walls", include_str!("../presets/walls.toml")),
    ("get-up", include_str!("../presets/get-up.toml")),
    ("ball-catch", include_str!("../presets/ball-catch.toml")),
];
