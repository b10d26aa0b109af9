//! The built-in experiments: every file `presets/NAME.toml` is the preset NAME.

include!(concat!(env!("OUT_DIR"), "/presets.rs"));
