//! The low level that is compiled into the programs.

use std::path::Path;

use comic_experiment::Transfer;

use super::file::Exported;
use crate::error::Error;

/// `data/README.md` says where it comes from.
const BYTES: &[u8] = include_bytes!("../../data/low_level.safetensors");

impl Exported {
    /// The built-in low level, or the file with this path. A file that is called `builtin` is `./builtin`.
    ///
    /// # Errors
    /// As [`Exported::open`].
    pub fn open_or_builtin(name: &Path) -> Result<Self, Error> {
        if name.as_os_str() == Transfer::BUILTIN { Self::read(BYTES.to_vec()) } else { Self::open(name) }
    }
}

#[cfg(test)]
mod tests {
    use comic_experiment::{TransferPrior, presets, resolve};

    use super::*;

    /// Most bytes of the file: it is in the repository and in both programs.
    const MOST: usize = 2_000_000;

    #[test]
    fn the_built_in_low_level_is_small_and_fits_every_preset_that_uses_it() {
        assert!(BYTES.len() <= MOST, "{} bytes", BYTES.len());
        let file = Exported::open_or_builtin(Path::new("builtin")).unwrap();
        assert!(file.freeze(&Transfer { prior: TransferPrior::State, ..Transfer::default() }).is_ok());
        let own = resolve("low-level", &[]).unwrap();
        assert_eq!((&file.experiment.clips, file.experiment.task), (&own.clips, own.task));
        let presets = presets::ALL.map(|(name, _)| resolve(name, &[]).unwrap());
        for mut preset in presets.into_iter().filter(|preset| preset.transfer.is_on()) {
            let described = preset.network.clone();
            file.describe_low_level(&mut preset.network).unwrap();
            // So a preset shows the sizes that its policy gets.
            assert_eq!(
                (preset.network.latent.size, preset.network.low_level),
                (described.latent.size, described.low_level)
            );
            assert!(file.freeze(&preset.transfer).is_ok(), "{}", preset.name);
        }
    }

    #[test]
    fn another_name_is_a_path() {
        let absent = Exported::open_or_builtin(Path::new("./builtin")).unwrap_err();
        assert!(matches!(absent, Error::File(_)), "{absent}");
    }
}
