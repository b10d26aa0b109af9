//! The native libraries that a release contains, and the licences that go with them.

use anyhow::{Context, Result};

/// A native library of a release.
pub(super) struct Library {
    pub(super) name: &'static str,
    /// The pinned wheel that it comes from.
    pub(super) wheel: &'static str,
    /// Its version, where that is not the wheel's.
    own_version: Option<&'static str>,
    /// SPDX expression, or the name of a licence that SPDX does not list.
    pub(super) licence: Licence,
    /// Its files, relative to `.deps`.
    pub(super) files: &'static [&'static str],
    /// Where the texts of its licence are, relative to the repository.
    pub(super) texts: &'static str,
    /// Whether only the simulator needs it.
    only_actor: bool,
}

/// A licence as CycloneDX distinguishes them.
pub(super) enum Licence {
    /// An SPDX expression.
    Spdx(&'static str),
    /// The name of a licence that SPDX does not list.
    Named(&'static str),
}

const CUDA: Licence = Licence::Named("NVIDIA CUDA Toolkit EULA");

const LIBRARIES: [Library; 5] = [
    Library {
        name: "libtorch",
        wheel: "torch",
        own_version: None,
        licence: Licence::Spdx("BSD-3-Clause"),
        files: &["libtorch/lib/libc10.so", "libtorch/lib/libtorch_cpu.so"],
        texts: ".deps/licences/torch",
        only_actor: false,
    },
    Library {
        name: "libgomp",
        wheel: "torch",
        // `strings` finds "gcc 8.5.0 20210514" in the file.
        own_version: Some("8.5.0"),
        licence: Licence::Spdx("GPL-3.0-or-later WITH GCC-exception-3.1"),
        files: &["libtorch/lib/libgomp.so.1"],
        texts: "deploy/licences/libgomp",
        only_actor: false,
    },
    // PyPI's only libtorch for Linux is linked with these two, and a CPU needs them to load it.
    Library {
        name: "libcudart",
        wheel: "nvidia-cuda-runtime-cu12",
        own_version: None,
        licence: CUDA,
        files: &["libtorch/lib/libcudart.so.12"],
        texts: ".deps/licences/nvidia_cuda_runtime_cu12",
        only_actor: false,
    },
    Library {
        name: "libcupti",
        wheel: "nvidia-cuda-cupti-cu12",
        own_version: None,
        licence: CUDA,
        files: &["libtorch/lib/libcupti.so.12"],
        texts: ".deps/licences/nvidia_cuda_cupti_cu12",
        only_actor: false,
    },
    Library {
        name: "libmujoco",
        wheel: "mujoco",
        own_version: None,
        licence: Licence::Spdx("Apache-2.0"),
        files: &["mujoco/lib/libmujoco.so.3.17.0"],
        texts: ".deps/licences/mujoco",
        only_actor: true,
    },
];

/// The native libraries that `program` needs.
pub(super) fn of(program: &str) -> impl Iterator<Item = &'static Library> {
    let simulates = program == "comic-actor";
    LIBRARIES.iter().filter(move |library| simulates || !library.only_actor)
}

impl Library {
    /// The version, and the SHA-256 of the wheel.
    pub(super) fn pin(&self) -> Result<(&'static str, &'static str)> {
        let (version, sha256) =
            comic_setup::pin(self.wheel).with_context(|| format!("set-up has no wheel {}", self.wheel))?;
        Ok((self.own_version.unwrap_or(version), sha256))
    }
}
